"""Hostile bodies: the service refuses them quickly with a clear message, before memory is spent."""

import base64
from contextlib import suppress

import httpx
import pytest

from retrieval.serve.uploads import MAX_HELD_BYTES
from tests.hostile_pictures import png_file
from tests.serving import connect, listening, problem, received, service


@pytest.fixture(scope="module")
def url(index):
    with listening(index, body_s=0.3) as (address, _):
        yield address


def post(client, *images):
    return client.post("/v1/query", json={"touches": [[base64.b64encode(image).decode() for image in images]]})


@pytest.mark.parametrize("image", [png_file(2**31 - 1, 2**31 - 1), b"", png_file(64, 64)[:40]])
def test_unusable_pictures_are_refused_with_their_place(client, image):
    good = png_file(8, 8, samples=b"\x00" * 8 * 25)
    detail = problem(post(client, good, image), 422, "bad-image")
    assert detail.startswith("grasp 1, finger b: ")


def test_the_pictures_of_one_request_have_a_common_limit(client):
    one = base64.b64encode(png_file(4000, 4000)).decode()
    detail = problem(client.post("/v1/query", json={"touches": [[one] * 2] * 4}), 413, "too-large")
    assert "may have 100,000,000 pixels in total; the large ones have 128,000,000" in detail
    tiny = base64.b64encode(png_file(1, 1, samples=bytes(4))).decode()
    detail = problem(client.post("/v1/query", json={"touches": [[tiny] * 5] * 26}), 422, "bad-input")
    assert detail == "A request may have at most 128 pictures, got 130."
    background = {"touches": [[tiny] * 2], "background": [tiny, ""]}
    detail = problem(client.post("/v1/query", json=background), 422, "bad-image")
    assert detail == "background of finger b: the file is empty"


JSON = {"content-type": "application/json"}
MANY = {
    "lists": b'{"touches":[' + b"[]," * 6_000_000 + b"[]]}",
    "keys": b'{"touches":[["aGk="]]' + b',"k":1' * 3_000_000 + b"}",
    "numbers": b'{"touches":[[' + b"1," * 9_000_000 + b"1]]}",
}


@pytest.mark.parametrize("name", MANY)
def test_a_body_with_too_many_values_is_refused_before_parsing(client, name):
    detail = problem(client.post("/v1/query", content=MANY[name], headers=JSON), 422, "bad-input")
    assert detail.startswith("A body may have at most 2,000 JSON values, got up to ")


@pytest.mark.parametrize(
    "body",
    [
        b'{"touches":[["aGk="]],"top":' + b"1" * 19_000_000 + b"}",
        b'{"' + b"k" * 19_000_000 + b'":1}',
        b'{"touches":[["' + b"\\u0041" * 3_000_000 + b'"]],"top":0}',
    ],
    ids=["integer", "key", "escapes"],
)
@pytest.mark.timeout(120)  # a parser of quadratic time takes hours
def test_a_value_of_19_mb_is_refused_soon(client, body):
    assert client.post("/v1/query", content=body, headers=JSON).status_code in (400, 422)


@pytest.mark.parametrize("path", ["/v1/session", "/v1/feedback"])
def test_only_bodies_with_pictures_may_be_large(client, path):
    large = client.post(path, content=b"[" * 16_385, headers=JSON)
    assert "at most 16,384 bytes" in problem(large, 413, "too-large")
    assert client.post(path, content=b"[" * 16_384, headers=JSON).status_code in (400, 422)


HEAD = "POST /v1/query HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: application/json\r\n"


def answer(connection):
    """Return status and bytes of the response until the connection ends; 413 if bytes in transit reset it."""
    data = received(connection)
    return int(data.split(b" ", 2)[1]) if data else 413, data


def test_an_announced_body_of_two_gigabytes_is_refused_before_the_first_byte(url):
    with connect(url, f"{HEAD}content-length: {2 * 2**30}\r\n\r\n".encode()) as line:
        status, data = answer(line)
    assert (status, b"at most 20,000,000 bytes" in data) == (413, True)


def test_a_body_without_content_length_is_cut_at_the_limit(url):
    with connect(url, f"{HEAD}transfer-encoding: chunked\r\n\r\n".encode()) as line:
        with suppress(OSError):  # refused while it is sent
            for _ in range(400):
                line.sendall(b"10000\r\n" + b"x" * 65536 + b"\r\n")
        assert answer(line)[0] in (413, 408)
    assert httpx.get(f"{url}/healthz").status_code == 200


def test_a_slow_body_is_refused_and_a_partial_body_is_harmless(url):
    part = f"{HEAD}content-length: 1000\r\n\r\n{{".encode()
    with connect(url, part) as line:
        status, data = answer(line)
        assert (status, b"The body must arrive within 0.3 s" in data) == (408, True)
    connect(url, part).close()
    assert httpx.get(f"{url}/healthz").status_code == 200


def test_concurrent_bodies_have_a_common_limit(index):
    with service(index) as client:
        limit = next(each for each in middlewares(client.app) if type(each).__name__ == "BodyLimit")
        for held, refusal in ((MAX_HELD_BYTES, (429, "busy")), (0, (422, "bad-image"))):
            limit.held_bytes = held
            problem(client.post("/v1/query", json={"touches": [["aGk="]]}), *refusal)
            assert limit.held_bytes == held


def middlewares(app):
    found = app.middleware_stack
    while hasattr(found, "app"):
        yield found
        found = found.app
