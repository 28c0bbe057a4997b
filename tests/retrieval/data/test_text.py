"""Text that cannot be encoded as UTF-8 is refused on input, or shown as U+FFFD. For catalogues: test_catalogue.py."""

import base64
import json
import shutil

from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint
from retrieval.serve.errors import HttpProblem
from robot.recording.folder import RecordingWriter
from tests.serving import INFO, service

HALF = "\ud83d"  # the first half of an emoji
NAME = "mug\udcff"  # the byte ff in a file name


def test_a_problem_response_with_a_file_name_that_is_not_utf8_is_valid_json():
    body = HttpProblem("unknown", f"{NAME}.jpg is gone").response().body
    assert json.loads(body)["detail"] == "mug\ufffd.jpg is gone"


def test_a_catalogue_in_a_folder_whose_name_is_not_utf8_is_served_and_half_characters_in_requests_are_refused(
    catalogue, touch, model, tmp_path
):
    folder = tmp_path / NAME
    shutil.copytree(catalogue, folder / "catalog")
    build_index(folder / "catalog", load_checkpoint(model), folder / "index")
    with (
        RecordingWriter(tmp_path / "recording", INFO) as writer,
        service(folder / "index", None, writer, history=tmp_path) as client,
    ):
        touches = [[base64.b64encode(path.read_bytes()).decode() for path in touch]]
        assert client.post("/v1/query", json={"touches": touches}).status_code == 200
        assert client.get("/v1/index").status_code == 200
        assert client.get("/v1/catalogue", params={"object": "mug\ufffd"}).status_code == 200
        for path, body in (
            ("/v1/feedback", rb'{"query": "x", "said": "object", "object_id": "mug\ud83d"}'),
            ("/v1/feedback", rb'{"query": "\ud83d", "said": "none"}'),
            ("/v1/session", rb'{"token": "\ud83d"}'),
            ("/v1/query", rb'{"touches": [["\ud83d"]], "\ud83d": 1}'),
        ):
            response = client.post(path, content=body, headers={"content-type": "application/json"})
            assert response.status_code in (400, 422), response.text
