"""A photo that was replaced after the build is not shown as the indexed one, and not recorded with feedback."""

import base64
import shutil

import cv2
import numpy as np

from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint
from retrieval.report.query import query_page
from retrieval.search.searcher import Searcher
from tests.serving import problem, with_history


def check(folder, get):
    catalogue, index, touch = shutil.copytree(get("catalogue"), folder / "catalog"), folder / "index", get("touch")
    build_index(catalogue, load_checkpoint(get("model")), index)
    with Searcher.open(index) as searcher:
        result = searcher.query(touch, top=2)
    shown, replaced = (match.photo for match in result.results)
    (catalogue / replaced).write_bytes(cv2.imencode(".png", np.zeros((40, 40, 3), np.uint8))[1].tobytes())
    assert query_page(result, catalogue).count("no picture") == 1
    with with_history(index, folder) as client:
        assert client.get(f"/v1/photos/{shown}").status_code == 200
        for px in ("", "?px=64"):
            detail = problem(client.get(f"/v1/photos/{replaced}{px}"), 404, "unknown")
            assert f"{replaced}" in detail
            assert "build-index" in detail
        encoded = [[base64.b64encode(path.read_bytes()).decode() for path in touch]]
        query = client.post("/v1/query", json={"touches": encoded}).headers["x-query-id"]
        name = result.results[1].object_id
        told = client.post("/v1/feedback", json={"query": query, "feedback": "object", "object_id": name}).json()
        assert not told["recorded"]
