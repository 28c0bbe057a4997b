"""Hostile bodies: refused with a sentence, soon, before memory is spent, and the service goes on."""

import base64
import io
import socket
import struct
import time
import zlib

import httpx
import pytest
from PIL import Image

from retrieval.errors import ImageError
from retrieval.serve.errors import Problem
from retrieval.serve.uploads import HELD_BYTES, check_pictures
from tests.serving import listening, problem, service


@pytest.fixture(scope="module")
def client(index):
    with service(index) as opened:
        yield opened


@pytest.fixture(scope="module")
def url(index):
    with listening(index, body_s=0.3) as (address, _):
        yield address


def png(width, height, data=b""):
    """A PNG file that says it has these sides; its samples, if any, are not that many."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def post(client, *images):
    return client.post("/v1/query", json={"touches": [[base64.b64encode(image).decode() for image in images]]})


@pytest.mark.parametrize(("width", "height"), [(4473, 4473), (50_000, 50_000), (2**31 - 1, 2**31 - 1)])
def test_a_picture_of_more_than_20_million_pixels_is_refused_by_its_header(client, width, height):
    told = problem(post(client, png(width, height), png(8, 8)), 422, "bad-image")
    assert told.startswith("grasp 1, finger a: ")
    assert "20" in told


def test_a_large_jpeg_is_refused_although_files_of_that_size_are_read_at_a_part_of_it(client):
    file = io.BytesIO()
    Image.new("L", (6000, 4000)).save(file, "JPEG")
    assert "6000 x 4000 pixels; at most 20,000,000 are taken" in problem(
        post(client, file.getvalue(), file.getvalue()), 422, "bad-image"
    )


@pytest.mark.parametrize(
    "image",
    [
        b"",
        b"\x00" * 1000,
        b"GIF89a" + b"\x00" * 100,
        png(64, 64, b"\x00" * 10),
        png(64, 64)[:40],
        b"<svg/>",
        b"\xff\xd8\xff",
    ],
    ids=["empty", "zeros", "gif", "too few samples", "cut off", "svg", "jpeg's first bytes"],
)
def test_what_is_no_whole_picture_is_refused_with_its_place(client, image):
    good = png(8, 8, b"\x00" * 8 * 25)
    assert "grasp 1, finger b" in problem(post(client, good, image), 422, "bad-image")


def test_the_pictures_of_one_request_have_a_bound_together():
    one = png(4000, 4000)
    assert check_pictures([[one, one], [one, one]], [one, one]) == 96_000_000
    with pytest.raises(Problem, match="may have 100,000,000 pixels together; got 112,000,000"):
        check_pictures([[one] * 7], None)
    with pytest.raises(Problem, match="at most 128 pictures; got 130"):
        check_pictures([[png(1, 1)] * 2] * 65, None)
    with pytest.raises(ImageError, match="background of finger b: the file is empty"):
        check_pictures([[png(1, 1)]], [png(1, 1), b""])


# Bodies on the line ---------------------------------------------------------------------------------------------------


def line(url):
    host, port = url.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)), timeout=30)


HEAD = "POST /v1/query HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: {kind}\r\n"


def answer(connection):
    """Status of what comes until the connection ends."""
    data = b""
    while more := connection.recv(65536):
        data += more
    return int(data.split(b" ", 2)[1]), data


@pytest.mark.parametrize("kind", ["application/json", "multipart/form-data; boundary=x", "text/plain"])
def test_two_gigabytes_that_are_announced_are_refused_before_the_first_byte(url, kind):
    with line(url) as connection:
        connection.sendall((HEAD.format(kind=kind) + f"content-length: {2 * 2**30}\r\n\r\n").encode())
        status, data = answer(connection)
    assert (status, b"at most 20,000,000 bytes" in data) == (413, True)


@pytest.mark.parametrize("kind", ["application/json", "multipart/form-data; boundary=x"])
def test_a_body_that_announces_nothing_is_cut_at_the_limit(url, kind):
    with line(url) as connection:
        connection.sendall((HEAD.format(kind=kind) + "transfer-encoding: chunked\r\n\r\n").encode())
        first = b'--x\r\ncontent-disposition: form-data; name="gelsight"; filename="a"\r\n\r\n'
        try:
            connection.sendall(f"{len(first):x}\r\n".encode() + first + b"\r\n")
            for _ in range(400):
                connection.sendall(b"10000\r\n" + b"x" * 65536 + b"\r\n")
        except OSError:
            pass  # it was refused while it was sent
        try:
            status, _ = answer(connection)
        except ConnectionError:
            status = 413  # what was still on its way had the connection reset
    assert status in (413, 408)
    assert httpx.get(f"{url}/healthz").status_code == 200


def test_a_slow_body_is_given_up_and_half_a_body_is_no_matter(url):
    with line(url) as connection:
        connection.sendall((HEAD.format(kind="application/json") + "content-length: 1000\r\n\r\n{").encode())
        begun = time.monotonic()
        status, data = answer(connection)
        assert (status, b"the body must come within 0.3 s" in data) == (408, True)
        assert time.monotonic() - begun < 20
    with line(url) as connection:
        connection.sendall((HEAD.format(kind="application/json") + "content-length: 1000\r\n\r\n{").encode())
    with line(url) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\nconnection: close\r\n\r\n")
        assert answer(connection)[0] == 200


def test_bodies_on_their_way_have_a_bound_together(index):
    assert HELD_BYTES == 80_000_000
    with service(index) as client:
        limit = next(each for each in middlewares(client.app) if type(each).__name__ == "BodyLimit")
        limit.held = HELD_BYTES
        refused = client.post("/v1/query", json={"touches": [["aGk="]]})
        assert "too many large requests" in problem(refused, 429, "busy")
        assert limit.held == HELD_BYTES


def middlewares(app):
    found = app.middleware_stack
    while hasattr(found, "app"):
        yield found
        found = found.app
