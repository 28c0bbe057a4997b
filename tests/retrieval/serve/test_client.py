"""The client over a real port: answers equal to the searcher's for all kinds of images, and its errors."""

import dataclasses
import itertools
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image

import retrieval
from retrieval.errors import BadInput, ImageError, RetrievalError
from retrieval.search.answer import Match
from tests.serving import listening

TOKEN = "a token of some length"
MATCH = Match(1, "mug", 0.0, None, "mug/1.jpg", "", {}, Path("/data/mug/1.jpg"))


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


def test_the_client_answers_like_the_searcher_for_images_of_every_kind(client, searcher, two_grasps):
    touch = two_grasps[0]
    images = [Image.open(path) for path in touch]
    inputs = [
        touch,
        [str(path) for path in touch],
        two_grasps,
        [np.asarray(image) for image in images],
        [path.read_bytes() for path in touch],
        images,
        [image.convert("CMYK") for image in images],
    ]
    for each, found in zip(inputs, client.query_many(inputs, top=3), strict=True):
        expected = searcher.query(each, top=3)
        assert without_times(found) == without_times(expected)
        assert found.results == expected.results  # photo_path too: both run on one machine
    assert client.query(two_grasps, opening_mm=[None, 40.5]).opening_mm == [None, 40.5]
    assert client.photo(found.results[0]) == found.results[0].photo_path.read_bytes()


def test_bad_queries_raise_the_errors_of_the_searcher(client, touch):
    with pytest.raises(ImageError, match=r"missing\.png: no such file"):
        client.query([touch[0], "missing.png"])
    with pytest.raises(BadInput, match=r"takes 2 gel image\(s\) for one touch; got 1"):
        client.query([touch[0]])
    with pytest.raises(BadInput, match="top: Input should be greater than or equal to 1"):
        client.query(touch, top=0)
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


def answered_by(monkeypatch, *answers):
    """Return a client that gets these answers, the last one for ever, and the list of its requests and pauses."""
    client, requested, left = retrieval.Client("http://elsewhere", timeout_s=10), [], list(answers)

    def respond(request):
        requested.append(request.url.raw_path.decode())
        return left.pop(0) if len(left) > 1 else left[0]

    transport = httpx.MockTransport(respond)
    monkeypatch.setattr(client, "_http", httpx.Client(base_url="http://elsewhere", transport=transport))
    monkeypatch.setattr("retrieval.serve.client.time.sleep", requested.append)
    return client, requested


@pytest.mark.parametrize(("retry_after", "pause"), [("3", 3.0), ("Wed, 21 Oct 2026 07:28:00 GMT", 1.0)])
def test_client_retries_a_busy_service_until_its_time_limit(monkeypatch, retry_after, pause):
    headers, document = {"retry-after": retry_after}, {"type": "urn:touch-retrieval:problem:busy", "detail": "all full"}
    busy = httpx.Response(429, headers=headers, json=document)
    client, requested = answered_by(monkeypatch, busy, busy, httpx.Response(200, content=b"its bytes"))
    assert client.photo(MATCH) == b"its bytes"
    assert requested[1::2] == [pause, pause]
    client, requested = answered_by(monkeypatch, busy)
    clock = itertools.count(step=4.0)
    monkeypatch.setattr("retrieval.serve.client.time.monotonic", lambda: next(clock))
    with pytest.raises(RetrievalError, match="all full"):
        client.photo(MATCH)
    assert len(requested) < 6


@pytest.mark.parametrize("content", [b"<html>hello</html>", b'{"other": 1}'])
def test_another_service_at_the_address_is_a_retrieval_error(touch, monkeypatch, content):
    client, _ = answered_by(monkeypatch, httpx.Response(200, content=content))
    with pytest.raises(RetrievalError, match="response \\(200\\); not a `retrieve serve` service"):
        client.query(touch)


def test_photo_names_are_quoted_in_the_path(monkeypatch):
    client, requested = answered_by(monkeypatch, httpx.Response(200, content=b"its bytes"))
    client.photo(dataclasses.replace(MATCH, photo="mug/a#b?50%41.jpg"))
    assert requested == ["/v1/photos/mug/a%23b%3F50%2541.jpg"]
