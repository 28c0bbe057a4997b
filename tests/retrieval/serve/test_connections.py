"""Half-sent, flooding and unread connections: they end soon, cost little, and do not block other clients."""

import socket
import time
from contextlib import ExitStack, contextmanager

import httpx
import pytest

from retrieval.serve import connections
from retrieval.serve.connections import MAX_CONNECTIONS, MAX_CONNECTIONS_OF_ADDRESS, MAX_HEADER_BYTES
from tests.serving import listening
from tests.waiting import wait_until

HALF_SENT = b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\nx-a: "


@pytest.fixture(scope="module")
def service_at(index):
    with listening(index) as (url, parts):
        host, port = url.removeprefix("http://").split(":")
        yield url, (host, int(port)), parts


@contextmanager
def opened(address, count, sent=HALF_SENT, source="127.0.0.1"):
    """Open `count` connections from an address and send `sent` on each."""
    with ExitStack() as stack:
        lines = []
        for _ in range(count):
            line = stack.enter_context(socket.create_connection(address, timeout=30, source_address=(source, 0)))
            line.sendall(sent)
            lines.append(line)
        yield lines


def received(line):
    """Return all bytes that the service sends until it closes the connection."""
    data = b""
    try:
        while more := line.recv(65536):
            data += more
    except ConnectionResetError:
        pass
    return data


def is_closed(line):
    """Return whether the service has closed a connection without sending anything."""
    line.setblocking(False)
    try:
        return not line.recv(1)
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True
    finally:
        line.setblocking(True)


def health_latency(url, source="127.0.0.1"):
    """Return the seconds until /healthz answers on a new connection from an address."""
    began = time.monotonic()
    with httpx.Client(transport=httpx.HTTPTransport(local_address=source), timeout=10) as client:
        assert client.get(f"{url}/healthz").status_code == 200
    return time.monotonic() - began


def test_half_sent_headers_end_at_a_deadline_and_a_silent_connection_too(service_at, monkeypatch):
    _, address, _ = service_at
    monkeypatch.setattr(connections, "HEADERS_S", 0.3)
    with opened(address, 1) as (partial,), opened(address, 1, b"") as (silent,):
        response = received(partial)
        assert response.startswith(b"HTTP/1.1 408 ")
        assert b"urn:touch-retrieval:problem:too-slow" in response
        assert b"within 0.3 s" in response
        assert received(silent) == b""


def test_headers_that_come_byte_by_byte_do_not_outlive_the_deadline(service_at, monkeypatch):
    _, address, _ = service_at
    monkeypatch.setattr(connections, "HEADERS_S", 0.5)
    with opened(address, 1) as (line,):
        for _ in range(200):
            time.sleep(0.05)
            try:
                line.sendall(b"a")
            except OSError:  # broken pipe or reset
                break
        else:
            pytest.fail("the connection lived for 10 s")


def test_a_half_sent_second_request_ends_at_a_deadline(service_at, monkeypatch):
    _, address, _ = service_at
    monkeypatch.setattr(connections, "HEADERS_S", 0.5)
    with opened(address, 1, b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n" + HALF_SENT) as (line,):
        response = received(line)
        assert response.startswith(b"HTTP/1.1 200 ")
        assert b"HTTP/1.1 408 " in response


def test_a_request_that_takes_longer_than_the_headers_may_is_answered(service_at, monkeypatch):
    url, _, parts = service_at
    monkeypatch.setattr(connections, "HEADERS_S", 0.2)
    monkeypatch.setattr(parts.generations.current.shard, "page", slow(parts.generations.current.shard.page, 1.5))
    assert httpx.get(f"{url}/v1/catalogue", timeout=30).status_code == 200


def slow(function, seconds):
    def call(*args):
        time.sleep(seconds)
        return function(*args)

    return call


def test_half_sent_headers_of_512_connections_block_no_client(service_at):
    url, address, _ = service_at
    with opened(address, MAX_CONNECTIONS) as lines:
        assert health_latency(url, "127.0.0.2") < 5
        assert health_latency(url) < 5  # from the same address, too
        wait_until(lambda: sum(map(is_closed, lines)) >= MAX_CONNECTIONS - MAX_CONNECTIONS_OF_ADDRESS)
        assert [is_closed(line) for line in (lines[0], lines[-1])] == [True, False]  # the oldest are closed


def test_half_sent_headers_from_many_addresses_block_no_client(service_at):
    url, address, _ = service_at
    with ExitStack() as stack:
        for number in range(10, 15):
            stack.enter_context(opened(address, MAX_CONNECTIONS_OF_ADDRESS, source=f"127.0.0.{number}"))
        assert health_latency(url, "127.0.0.2") < 5


def test_busy_connections_are_not_closed_for_new_ones(service_at, monkeypatch):
    _, address, parts = service_at
    monkeypatch.setattr(parts.generations.current.shard, "page", slow(parts.generations.current.shard.page, 3))
    whole = b"GET /v1/catalogue HTTP/1.1\r\nhost: 127.0.0.1\r\nconnection: close\r\n\r\n"
    with opened(address, 1, whole) as (line,), opened(address, 2 * MAX_CONNECTIONS_OF_ADDRESS):
        assert received(line).startswith(b"HTTP/1.1 200 ")


def test_an_idle_connection_of_a_client_is_closed_after_half_sent_ones(service_at):
    url, address, _ = service_at
    with httpx.Client(timeout=10) as client:
        client.get(f"{url}/healthz")
        (idle,) = client._transport._pool.connections
        with opened(address, MAX_CONNECTIONS_OF_ADDRESS + 20):
            client.get(f"{url}/healthz")
            assert client._transport._pool.connections == [idle]


def test_headers_larger_than_the_limit_are_refused_at_once(service_at):
    _, address, _ = service_at
    begin = b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\n"
    with opened(address, 1, begin + b"x-a: " + b"a" * (MAX_HEADER_BYTES - 100) + b"\r\nconnection: close\r\n\r\n") as (
        line,
    ):
        assert received(line).startswith(b"HTTP/1.1 200 ")
    for flood, limit in (
        (b"x-a: " + b"a" * 10**6, b"16,384 bytes of headers"),
        (b"x" * 10**6, b"16,384 bytes of headers"),
        (b"x-a: b\r\n" * 10**5, b"100 headers"),
    ):
        with opened(address, 1, begin + flood[: 2 * MAX_HEADER_BYTES]) as (line,):
            response = received(line)
            assert response.startswith(b"HTTP/1.1 431 ")
            assert b"A request may have at most " + limit in response


def test_the_lines_of_a_body_do_not_count_as_headers(service_at):
    url, address, _ = service_at
    with httpx.Client(timeout=30) as client:
        for _ in range(3):
            body, kind = b'{"token": "a"\n' + b"\r\n" * 1_000 + b"}", {"content-type": "application/json"}
            answer = client.post(f"{url}/v1/session", content=body, headers=kind)
            assert answer.status_code == 204, answer.text
    head = b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\n" + b"a: b\r\n" * 90
    with opened(address, 1, (head + b"\r\n") * 2 + head + b"connection: close\r\n\r\n") as (line,):
        assert received(line).count(b"HTTP/1.1 200 ") == 3


def test_invalid_http_gets_a_problem_document(service_at):
    _, address, _ = service_at
    with opened(address, 1, b"\x16\x03\x01 hello\r\n\r\n") as (line,):
        response = received(line)
        assert response.startswith(b"HTTP/1.1 400 ")
        assert b"urn:touch-retrieval:problem:malformed" in response


def test_a_body_of_tiny_chunks_is_refused_and_one_of_larger_chunks_is_read(service_at):
    url, address, _ = service_at
    head = b"POST /v1/session HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: application/json\r\n"
    head += b"transfer-encoding: chunked\r\n\r\n"
    with opened(address, 1, head + b"1\r\n \r\n" * 20_000) as (line,):
        response = received(line)
        assert response.startswith(b"HTTP/1.1 400 ")
        assert b"malformed" in response
    chunks = (b" " * 300 for _ in range(2_000))
    answer = httpx.post(f"{url}/v1/query", content=chunks, headers={"content-type": "application/json"}, timeout=30)
    assert answer.json()["type"].endswith(("malformed", "bad-input"))  # no JSON, but read


def test_a_flood_of_pipelined_requests_is_answered_one_by_one(service_at):
    url, address, _ = service_at
    with opened(address, 1, b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n" * 1_000) as (line,):
        assert health_latency(url) < 5
        data = b""
        while data.count(b"HTTP/1.1 200 ") < 1_000:
            data += (more := line.recv(65536))
            assert more


def test_a_client_that_does_not_read_its_response_is_cut_off(index, monkeypatch):
    monkeypatch.setattr(connections, "UNREAD_S", 0.5)
    monkeypatch.setattr(connections, "CLOSING_S", 0.5)
    with listening(index) as (url, _):
        host, port = url.removeprefix("http://").split(":")
        line = socket.socket()
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with line:
            line.connect((host, int(port)))
            line.settimeout(30)
            line.sendall(b"GET /openapi.json HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n" * 500)
            time.sleep(3)
            assert 0 < received(line).count(b"HTTP/1.1 200 ") < 500
