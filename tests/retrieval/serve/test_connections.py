"""Connections that send no valid headers."""

from retrieval.serve.server import MAX_HEADER_BYTES
from tests.serving import connect, listening, received

BEGIN = b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\n"


def test_headers_above_the_limit_and_invalid_http_are_refused_at_once(index):
    end = b"\r\nconnection: close\r\n\r\n"
    floods = (BEGIN + b"x-a: " + b"a" * 10**6, BEGIN + b"x-a: b\r\n" * 10**5, b"\x16\x03\x01 hello\r\n\r\n")
    with listening(index) as (url, _):
        with connect(url, BEGIN + b"x-a: " + b"a" * (MAX_HEADER_BYTES - 100) + end) as line:
            assert received(line).startswith(b"HTTP/1.1 200 ")
        for flood in floods:
            with connect(url, flood[: 20 * MAX_HEADER_BYTES]) as line:
                assert received(line).startswith(b"HTTP/1.1 400 ")
