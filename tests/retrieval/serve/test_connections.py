"""Half-sent, flooding and unread connections: they end soon, cost little, and do not block other clients."""

import socket
import time
from contextlib import ExitStack

import httpx
import pytest

from retrieval.serve import server
from retrieval.serve.server import MAX_CONNECTIONS, MAX_HEADER_BYTES
from tests.serving import connect, listening, received

pytestmark = pytest.mark.slow

BEGIN = b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\n"
HALF_SENT = BEGIN + b"x-a: "


@pytest.fixture(scope="module")
def service_at(index):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(server, "HEADERS_S", 1.0)
        with listening(index) as (url, parts):
            yield url, parts


@pytest.mark.parametrize("sent", [HALF_SENT, b"", BEGIN + b"\r\n" + HALF_SENT], ids=["half", "silent", "second"])
def test_half_sent_headers_and_silent_connections_end_at_a_deadline(service_at, sent):
    with connect(service_at[0], sent) as line:
        assert received(line).count(b"HTTP/1.1 200 ") == sent.count(b"\r\n\r\n")


def test_headers_that_come_byte_by_byte_do_not_outlive_the_deadline(service_at):
    with connect(service_at[0], HALF_SENT) as line:
        for _ in range(200):
            time.sleep(0.05)
            try:
                line.sendall(b"a")
            except OSError:  # broken pipe or reset
                break
        else:
            pytest.fail("the connection lived for 10 s")


def test_a_request_that_takes_longer_than_the_headers_may_is_answered(service_at, monkeypatch):
    url, parts = service_at
    shard = parts.generations.current.shard
    page = shard.page
    monkeypatch.setattr(shard, "page", lambda *args: time.sleep(2) or page(*args))
    assert httpx.get(f"{url}/v1/catalogue", timeout=30).status_code == 200


def test_the_longest_waiting_connections_are_closed_for_new_ones(index):
    with listening(index) as (url, parts), ExitStack() as stack:
        shard = parts.generations.current.shard
        page = shard.page
        shard.page = lambda *args: time.sleep(3) or page(*args)
        whole = b"GET /v1/catalogue HTTP/1.1\r\nhost: 127.0.0.1\r\nconnection: close\r\n\r\n"
        busy, *lines = (stack.enter_context(connect(url, sent)) for sent in (whole, *[HALF_SENT] * MAX_CONNECTIONS))
        for _ in range(3):
            assert httpx.get(f"{url}/healthz", timeout=10).status_code == 200
        assert received(lines[0]) == b""
        lines[-1].sendall(b"b\r\nconnection: close\r\n\r\n")
        assert received(lines[-1]).startswith(b"HTTP/1.1 200 ")
        assert received(busy).startswith(b"HTTP/1.1 200 ")


def test_headers_above_the_limit_and_invalid_http_are_refused_at_once(service_at):
    end = b"\r\nconnection: close\r\n\r\n"
    with connect(service_at[0], HALF_SENT + b"a" * (MAX_HEADER_BYTES - 100) + end) as line:
        assert received(line).startswith(b"HTTP/1.1 200 ")
    for flood in (HALF_SENT + b"a" * 10**6 + end, BEGIN + b"x-a: b\r\n" * 10**5 + end, b"\x16\x03\x01 hello\r\n\r\n"):
        with connect(service_at[0], flood[: 3 * MAX_HEADER_BYTES]) as line:
            assert received(line).startswith(b"HTTP/1.1 400 ")


def test_a_client_that_does_not_read_its_response_is_cut_off(index, monkeypatch):
    monkeypatch.setattr(server, "UNREAD_S", 0.5)
    with listening(index) as (url, _), socket.socket() as line:
        host, port = url.removeprefix("http://").split(":")
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.connect((host, int(port)))
        line.settimeout(30)
        line.sendall(b"GET /openapi.json HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n" * 500)
        time.sleep(3)
        assert 0 < received(line).count(b"HTTP/1.1 200 ") < 500
