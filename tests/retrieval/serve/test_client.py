"""The client over a real port: answers equal to the searcher's for all kinds of images, and its errors."""

from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image

import retrieval
from retrieval.errors import BadInput, ImageError, RetrievalError
from retrieval.search.query.answer import Match, QueryResult
from tests.serving import listening

TOKEN = "a token of some length"


@pytest.fixture(scope="module")
def url(index):
    with listening(index, token=TOKEN) as (address, _):
        yield address


@pytest.fixture(scope="module")
def client(url):
    with retrieval.Client(url, token=TOKEN) as client:
        yield client


def without_times(result):
    return {**result.to_dict(), "timing_ms": None}


def test_client_answers_to_files_equal_the_searchers(client, searcher, touch):
    for touches in (touch, [touch, touch], [str(path) for path in touch]):
        expected = searcher.query(touches, top=3)
        found = client.query(touches, top=3)
        assert without_times(found) == without_times(expected)
        assert found.results == expected.results  # photo_path too: both run on one machine
        assert client.photo(found.results[0]) == found.results[0].photo_path.read_bytes()


def test_arrays_bytes_and_pillow_images_give_the_same_ranking(client, searcher, touch):
    images = [Image.open(path) for path in touch]
    inputs = [
        [np.asarray(image) for image in images],
        [path.read_bytes() for path in touch],
        images,
        [image.convert("L") for image in images],
        [image.convert("CMYK") for image in images],
    ]
    for each in inputs:
        expected, found = searcher.query(each), client.query(each)
        assert found.results == expected.results
        assert found.touches == expected.touches


def test_client_batch_queries_match_the_searcher(client, searcher, touch):
    many = [touch, [touch, touch]]
    for found, expected in zip(client.query_many(many), searcher.query_many(many), strict=True):
        assert without_times(found) == without_times(expected)
    assert client.query_many([]) == []


def test_bad_queries_raise_the_errors_of_the_searcher(client, touch, tmp_path):
    (tmp_path / "x.png").write_bytes(b"not a picture")
    with pytest.raises(ImageError, match=r"missing\.png: no such file"):
        client.query([touch[0], "missing.png"])
    with pytest.raises(ImageError, match="grasp 1, finger b: not a PNG"):
        client.query([touch[0], tmp_path / "x.png"])
    with pytest.raises(BadInput, match=r"takes 2 gel image\(s\) for one touch; got 1"):
        client.query([touch[0]])
    with pytest.raises(BadInput, match="top: Input should be greater than or equal to 1"):
        client.query(touch, top=0)
    with pytest.raises(BadInput, match="tip: Extra inputs are not permitted"):
        client.query(touch, tip=3)
    with pytest.raises(ImageError, match="an array must contain uint8"):
        client.query([np.zeros((4, 4, 3))] * 2)


def test_wrong_token_and_missing_service_are_reported(url, touch):
    with retrieval.Client(url, token="wrong") as client, pytest.raises(BadInput, match="Send the service's token"):
        client.query(touch)
    with (
        retrieval.Client("http://127.0.0.1:1") as client,
        pytest.raises(RetrievalError, match=r"Cannot reach .* Is `retrieve serve` running there"),
    ):
        client.query(touch)


def test_client_retries_a_busy_service(client, touch, monkeypatch):
    """The client waits for `Retry-After`; if the time limit comes first, it raises."""
    from retrieval.serve import client as module

    answers, waited = [429, 429], []

    class Busy:
        def request(self, *args, **kwargs):
            if not answers:
                return real.request(*args, **kwargs)
            headers, problem = {"retry-after": "3"}, {"type": "urn:touch-retrieval:problem:busy", "detail": "all full"}
            return module.httpx.Response(answers.pop(), headers=headers, json=problem)

    real = client._http
    monkeypatch.setattr(client, "_http", Busy())
    monkeypatch.setattr(module.time, "sleep", waited.append)
    assert client.query(touch).results
    assert waited == [3.0, 3.0]
    answers.append(429)
    monkeypatch.setattr(client, "_timeout_s", 1)
    with pytest.raises(RetrievalError, match="all full"):
        client.query(touch)


def answered_by(monkeypatch, answer):
    """Return a client that gets `answer` to each request, and the list of its requested paths and pauses."""
    from retrieval.serve import client as module

    client, requested = retrieval.Client("http://elsewhere"), []

    def respond(request):
        requested.append(request.url.raw_path.decode())
        return answer

    transport = module.httpx.MockTransport(respond)
    monkeypatch.setattr(client, "_http", module.httpx.Client(base_url="http://elsewhere", transport=transport))
    monkeypatch.setattr(module.time, "sleep", lambda seconds: requested.append(seconds))
    return client, requested


@pytest.mark.parametrize("content", [b"<html>hello</html>", b"[]", b'{"other": 1}'])
def test_another_service_at_the_address_is_a_retrieval_error(touch, monkeypatch, content):
    client, _ = answered_by(monkeypatch, httpx.Response(200, content=content))
    with pytest.raises(RetrievalError, match="response \\(200\\); not a `retrieve serve` service"):
        client.query(touch)


def test_client_retries_after_one_second_if_retry_after_is_a_date(touch, monkeypatch):
    headers = {"retry-after": "Wed, 21 Oct 2026 07:28:00 GMT"}
    client, requested = answered_by(monkeypatch, httpx.Response(503, headers=headers))
    monkeypatch.setattr(client, "_timeout_s", 1.5)
    clock = iter([0.0, 0.1, 1.0])
    monkeypatch.setattr("retrieval.serve.client.time.monotonic", lambda: next(clock))
    with pytest.raises(RetrievalError, match=r"response \(503\)"):
        client.query(touch)
    assert requested == ["/v1/index", 1.0, "/v1/index"]


@pytest.mark.parametrize(
    ("photo", "path"), [("mug/a#b.jpg", "mug/a%23b.jpg"), ("a?b.jpg", "a%3Fb.jpg"), ("50%41.jpg", "50%2541.jpg")]
)
def test_photo_names_are_quoted_in_the_path(monkeypatch, photo, path):
    client, requested = answered_by(monkeypatch, httpx.Response(200, content=b"its bytes"))
    match = Match(1, "mug", 0.0, None, photo, {}, Path("/data") / photo)
    assert client.photo(match) == b"its bytes"
    assert requested == [f"/v1/photos/{path}"]


def test_an_answer_is_restored_from_its_document(searcher, touch):
    answer = searcher.query(touch)
    assert QueryResult.from_dict(answer.to_dict()) == answer
    for broken in ({}, {**answer.to_dict(), "results": [{}]}):
        with pytest.raises(BadInput, match="not a document of `retrieve query --json`"):
            QueryResult.from_dict(broken)
