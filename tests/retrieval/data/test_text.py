"""Text that cannot be encoded as UTF-8 is refused on input, or shown as U+FFFD."""

import json
import shutil

import pytest

from retrieval.data.catalogue import list_catalogue
from retrieval.data.text import is_utf8, replace_surrogates
from retrieval.errors import DatasetError
from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint
from retrieval.serve.errors import HttpProblem
from robot.errors import RecordingError
from robot.recording.folder import RecordingWriter, read_recording
from tests.serving import INFO, service

HALF = "\ud83d"  # the first half of an emoji
NAME = "mug\udcff"  # the byte ff in a file name


@pytest.mark.parametrize(
    "line",
    [
        r'{"object_id": "mug", "note": "nice \ud83d"}',
        r'{"object_id": "mug", "\ude00": 1}',
        r'{"object_id": "mug\ud83d", "note": 1}',
        r'{"object_id": "mug", "deep": [{"a": ["\udfff"]}]}',
    ],
)
def test_a_lone_surrogate_in_the_metadata_of_a_catalogue_is_refused_with_its_line(catalogue_copy, line):
    (catalogue_copy / "metadata.jsonl").write_text('{"object_id": "a", "note": "\\ud83d\\ude00"}\n' + line + "\n")
    with pytest.raises(DatasetError, match=r"metadata.jsonl, line 2: contains a lone surrogate") as raised:
        list_catalogue(catalogue_copy)
    assert "\n" not in str(raised.value)


def test_a_surrogate_pair_of_two_escapes_is_accepted(catalogue_copy):
    name = sorted(path.name for path in catalogue_copy.iterdir())[0]
    (catalogue_copy / "metadata.jsonl").write_text(json.dumps({"object_id": name, "note": "\U0001f600"}) + "\n")
    assert list_catalogue(catalogue_copy).photos[0].metadata == {"note": "\U0001f600"}


def test_a_lone_surrogate_in_a_recording_is_refused_with_its_line(recording, tmp_path):
    (tmp_path / "recording.json").write_bytes((recording / "recording.json").read_bytes())
    line = (recording / "metadata.jsonl").read_text().splitlines()[0]
    row = {**json.loads(line), "object_id": f"mug{HALF}"}
    (tmp_path / "metadata.jsonl").write_text(f"{line}\n{json.dumps({**row, 'grasp_id': 'other'})}\n")
    with pytest.raises(RecordingError, match=r"metadata.jsonl, line 2: must be JSON in UTF-8"):
        read_recording(tmp_path)


def test_valid_text_is_returned_as_the_same_object():
    document = {"a": ["é", "\U0001f600", 1.5, None]}
    assert replace_surrogates(document) is document
    assert not is_utf8({HALF: 1})


def test_a_problem_response_with_a_file_name_that_is_not_utf8_is_valid_json():
    body = HttpProblem("unknown", f"{NAME}.jpg is gone").response().body
    assert json.loads(body)["detail"] == "mug\ufffd.jpg is gone"


def test_a_catalogue_in_a_folder_whose_name_is_not_utf8_is_served(catalogue, touch, model, tmp_path):
    folder = tmp_path / NAME
    shutil.copytree(catalogue, folder / "catalog")
    build_index(folder / "catalog", load_checkpoint(model), folder / "index", quiet=True)
    with service(folder / "index") as client:
        names = {"gelsight": [(path.name, path.read_bytes()) for path in touch]}
        files = [("gelsight", file) for file in names["gelsight"]]
        assert client.post("/v1/query", files=files).status_code == 200
        assert client.get("/v1/index").status_code == 200
        assert client.get("/v1/catalogue").status_code == 200


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/v1/feedback", rb'{"query": "x", "said": "object", "object_id": "mug\ud83d"}'),
        ("/v1/feedback", rb'{"query": "\ud83d", "said": "none"}'),
        ("/v1/session", rb'{"token": "\ud83d"}'),
        ("/v1/query", rb'{"touches": [["\ud83d"]], "\ud83d": 1}'),
    ],
)
def test_a_lone_surrogate_in_a_request_body_is_refused(index, tmp_path, path, body):
    with (
        RecordingWriter(tmp_path / "recording", INFO) as writer,
        service(index, None, writer, history=tmp_path) as client,
    ):
        response = client.post(path, content=body, headers={"content-type": "application/json"})
        assert response.status_code in (400, 422), response.text
        assert client.get("/v1/catalogue", params={"object": "mug\ufffd"}).status_code == 200
