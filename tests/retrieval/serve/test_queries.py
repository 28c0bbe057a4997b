"""Queries over HTTP: the same answers as in Python, and refused bodies."""

import base64
import json

import pytest

from retrieval.search.searcher import Searcher
from tests.serving import problem, service
from tests.verification import calibration, verified_index


@pytest.fixture(scope="module")
def grasps(two_grasps):
    """The image files of two grasps of one object."""
    return [[path.read_bytes() for path in grasp] for grasp in two_grasps]


def encoded(grasps):
    return [[base64.b64encode(image).decode() for image in grasp] for grasp in grasps]


def without_times(document):
    """Return a document with only the names of the timed stages."""
    return document | {"timing_ms": set(document["timing_ms"])}


def test_a_query_returns_the_document_of_the_searcher(client, searcher, grasps):
    for touches, openings in ((grasps[:1], None), (grasps, [None, 40.5])):
        expected = without_times(searcher.query(touches, opening_mm=openings, top=3, none_prior=0.2).to_dict())
        options = {"opening_mm": openings, "top": 3, "none_prior": 0.2}
        answer = client.post("/v1/query", json={"touches": encoded(touches), **options})
        assert without_times(answer.json()) == expected


def test_verification_returns_the_document_of_the_searcher(grasps, model, catalogue, tmp_path):
    index = verified_index(tmp_path, model, catalogue, calibration(-1e3, -2e3))
    with Searcher.open(index) as searcher, service(index) as client:
        name = searcher.generation.rows[0].object_id
        found = client.post("/v1/verify", json={"expect": name, "touches": encoded(grasps), "far": 0.1}).json()
        assert found["decision"] == "accept"
        assert found == json.loads(json.dumps(searcher.verify(grasps, name, far=0.1).to_dict()))
        body = {"expect": name, "touches": encoded(grasps), "far": 0}
        assert "far" in problem(client.post("/v1/verify", json=body), 422, "bad-input")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"touches": [["%%%"]]}, "touches.0.0: Value error, must be an image file in base64"),
        ({"touches": [["aGk="]], "tops": 3}, "tops: Extra inputs are not permitted"),
        ({"touches": [["aGk="]], "top": 0}, "top: Input should be greater than or equal to 1"),
    ],
)
def test_an_invalid_body_is_reported_with_the_place(client, body, message):
    assert message in problem(client.post("/v1/query", json=body), 422, "bad-input")


@pytest.mark.parametrize(
    ("kind", "content", "status", "problem_kind"),
    [
        ("text/plain", b"x", 415, "unsupported-type"),
        ("application/json", b"{", 400, "malformed"),
    ],
)
def test_other_content_types_and_broken_bodies_are_refused(client, kind, content, status, problem_kind):
    problem(client.post("/v1/query", content=content, headers={"content-type": kind}), status, problem_kind)
