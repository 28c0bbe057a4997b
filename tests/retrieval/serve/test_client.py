"""The client over a real port: what a searcher answers, however images are given; and what it says when it cannot."""

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
    with retrieval.Client(url, token=TOKEN) as opened:
        yield opened


def compared(result):
    return {**result.to_dict(), "timing_ms": None}


def test_the_client_answers_files_as_the_searcher_does(client, searcher, touch):
    for given in (touch, [touch, touch], [str(path) for path in touch]):
        expected = searcher.query(given, top=3)
        found = client.query(given, top=3)
        assert compared(found) == compared(expected)
        assert found.results == expected.results  # photo_path too: both run on one machine
        assert client.photo(found.results[0]) == found.results[0].photo_path.read_bytes()


def test_arrays_bytes_and_pillow_images_give_the_same_ranking(client, searcher, touch):
    images = [Image.open(path) for path in touch]
    given = [
        [np.asarray(image) for image in images],
        [path.read_bytes() for path in touch],
        images,
        [image.convert("L") for image in images],
        [image.convert("CMYK") for image in images],
    ]
    for each in given:
        expected, found = searcher.query(each), client.query(each)
        assert found.results == expected.results
        assert found.touches == expected.touches


def test_client_batch_and_cumulative_queries_match_the_searcher(client, searcher, touch):
    many, growing = [touch, [touch, touch]], [touch, touch]
    for found, expected in zip(client.query_many(many), searcher.query_many(many), strict=True):
        assert compared(found) == compared(expected)
    for found, expected in zip(client.query_cumulative(growing), searcher.query_cumulative(growing), strict=True):
        assert compared(found) == compared(expected)
    assert client.query_many([]) == []


def test_what_cannot_be_asked_raises_as_the_searcher_does(client, touch, tmp_path):
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
    with pytest.raises(ImageError, match="an array must hold uint8"):
        client.query([np.zeros((4, 4, 3))] * 2)


def test_without_the_token_and_without_a_service_it_says_so(url, touch):
    with retrieval.Client(url, token="wrong") as client, pytest.raises(BadInput, match="send the service's token"):
        client.query(touch)
    with (
        retrieval.Client("http://127.0.0.1:1") as client,
        pytest.raises(RetrievalError, match=r"cannot be reached .*; is `retrieve serve` running there"),
    ):
        client.query(touch)


def test_a_busy_service_is_asked_again(client, touch, monkeypatch):
    """It says when; where the time is over before, that it is busy is told."""
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
    """A client whose requests `answer` answers; and the paths that it asked for, as they are sent."""
    from retrieval.serve import client as module

    client, asked = retrieval.Client("http://elsewhere"), []

    def respond(request):
        asked.append(request.url.raw_path.decode())
        return answer

    transport = module.httpx.MockTransport(respond)
    monkeypatch.setattr(client, "_http", module.httpx.Client(base_url="http://elsewhere", transport=transport))
    monkeypatch.setattr(module.time, "sleep", lambda seconds: asked.append(seconds))
    return client, asked


@pytest.mark.parametrize("content", [b"<html>hello</html>", b"[]", b'{"other": 1}'])
def test_another_service_at_that_address_is_an_error_of_ours(touch, monkeypatch, content):
    client, _ = answered_by(monkeypatch, httpx.Response(200, content=content))
    with pytest.raises(RetrievalError, match="answered 200, and not as `retrieve serve` does"):
        client.query(touch)


def test_a_proxy_that_names_a_date_to_come_again_is_asked_again_in_a_second(touch, monkeypatch):
    headers = {"retry-after": "Wed, 21 Oct 2026 07:28:00 GMT"}
    client, asked = answered_by(monkeypatch, httpx.Response(503, headers=headers))
    monkeypatch.setattr(client, "_timeout_s", 1.5)
    clock = iter([0.0, 0.1, 1.0])
    monkeypatch.setattr("retrieval.serve.client.time.monotonic", lambda: next(clock))
    with pytest.raises(RetrievalError, match="answered 503"):
        client.query(touch)
    assert asked == ["/v1/index", 1.0, "/v1/index"]


@pytest.mark.parametrize(
    ("photo", "path"), [("mug/a#b.jpg", "mug/a%23b.jpg"), ("a?b.jpg", "a%3Fb.jpg"), ("50%41.jpg", "50%2541.jpg")]
)
def test_a_photo_of_any_name_is_asked_for_by_that_name(monkeypatch, photo, path):
    client, asked = answered_by(monkeypatch, httpx.Response(200, content=b"its bytes"))
    match = Match(1, "mug", 0.0, None, photo, {}, Path("/data") / photo)
    assert client.photo(match) == b"its bytes"
    assert asked == [f"/v1/photos/{path}"]


def test_an_answer_comes_back_from_its_document(searcher, touch):
    answer = searcher.query(touch)
    assert QueryResult.from_dict(answer.to_dict()) == answer
    for broken in ({}, {**answer.to_dict(), "results": [{}]}):
        with pytest.raises(BadInput, match="not the document of `retrieve query --json`"):
            QueryResult.from_dict(broken)
