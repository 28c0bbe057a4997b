"""A service in trouble: writes that fail, a full disk, a database that is gone, a rig or a disk that hangs."""

import asyncio
import base64
import errno
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import httpx
import pytest

from retrieval.errors import RetrievalError
from retrieval.serve.app import MAX_RIG_GRASPS
from retrieval.serve.history_writer import MAX_PENDING_WRITES, HistoryWriter
from retrieval.serve.metrics import Metrics
from retrieval.serve.queue import QueryAnswer
from retrieval.serve.service import GraspResult, LiveRig
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.uploads import Options, ParsedQuery, pictures_of
from robot.recording.folder import RecordingWriter
from tests.retrieval.serve.test_connections import opened
from tests.serving import INFO, listening, problem, with_history
from tests.waiting import wait_until


@pytest.fixture(scope="module")
def grasp(touch):
    return [path.read_bytes() for path in touch]


@pytest.fixture(scope="module")
def body(grasp):
    return {"touches": [[base64.b64encode(data).decode() for data in grasp]]}


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "history"


@pytest.fixture
def client(index, folder):
    with with_history(index, folder) as opened:
        yield opened


def ask(client, body):
    response = client.post("/v1/query", json=body)
    assert response.status_code == 200
    return response.headers.get("x-query-id")


# The writer of the history -------------------------------------------------------------------------------------------


class Unforeseen(BaseException):
    """What no program expects."""


UNFORESEEN = (
    lambda: ValueError("x"),
    lambda: KeyError("x"),
    lambda: MemoryError(),
    lambda: RecursionError("x"),
    lambda: StopIteration("x"),
    lambda: StopAsyncIteration("x"),
    lambda: GeneratorExit("x"),
    lambda: KeyboardInterrupt(),
    lambda: SystemExit(1),
    lambda: asyncio.CancelledError(),
    lambda: OSError(errno.ENOSPC, "No space left on device"),
    lambda: sqlite3.ProgrammingError("x"),
    lambda: UnicodeEncodeError("utf-8", "\ud83d", 0, 1, "surrogates not allowed"),
    lambda: Unforeseen("x"),
)


def test_the_writer_survives_a_thousand_unforeseen_exceptions(index, folder, grasp, body, monkeypatch):
    raised = []

    def fail(*_):
        error = UNFORESEEN[len(raised) % len(UNFORESEEN)]()
        raised.append(error)
        raise error

    with with_history(index, folder) as client:
        stored, names = client.app.state.service.with_history, []
        with monkeypatch.context() as patch:
            patch.setattr(stored.store, "keep", fail)
            for _ in range(1_000):
                wait_until(lambda: len(stored._pending) < MAX_PENDING_WRITES)
                names.append(stored.keep(ParsedQuery(pictures_of([[grasp]], None), Options()), QueryAnswer(None, "m")))
            wait_until(lambda: len(raised) == 1_000)
        assert client.get("/v1/history").json()["total"] == 0
        assert "could not be stored: 'x'" in problem(client.get(f"/v1/history/{names[1]}"), 404, "unknown")
        assert b'retrieve_history_failures_total{what="query"} 1000.0' in client.get("/metrics").content
        query = ask(client, body)
        assert [item["id"] for item in client.get("/v1/history").json()["items"]] == [query]
        began = time.monotonic()
    assert time.monotonic() - began < 10


def test_the_history_answers_while_the_writer_hangs_and_says_that_a_query_is_being_stored(client, body, monkeypatch):
    go, store = threading.Event(), client.app.state.service.with_history.store
    keep = store.keep
    monkeypatch.setattr(store, "keep", lambda *row: go.wait(60) and keep(*row))
    query = ask(client, body)
    assert client.get("/v1/history").json()["total"] == 0
    told = client.post("/v1/feedback", json={"query": query, "feedback": "none"})
    assert problem(told, 503, "not-ready") == f"query {query} is still being stored; come again"
    for _ in range(MAX_PENDING_WRITES):
        last = ask(client, body)
    assert last is None  # too many wait, and the answer says so: it has no id
    go.set()
    wait_until(lambda: client.get("/v1/history").json()["total"] == MAX_PENDING_WRITES)


# The disk ------------------------------------------------------------------------------------------------------------


def test_a_query_that_a_full_disk_refused_is_told_by_its_reason(client, body):
    store = client.app.state.service.with_history.store
    first = ask(client, body)
    client.get("/v1/history")
    (pages,) = store._database.execute("PRAGMA page_count").fetchone()
    store._database.execute(f"PRAGMA max_page_count = {pages}")
    query = ask(client, body)
    for response in (
        client.get(f"/v1/history/{query}"),
        client.post("/v1/feedback", json={"query": query, "feedback": "none"}),
    ):
        told = problem(response, 404, "unknown")
        assert told.startswith(f"query {query} could not be stored: ")
        assert told.endswith("cannot be written: database or disk is full")
    store._database.execute("PRAGMA max_page_count = 1000000")
    assert client.get(f"/v1/history/{first}").status_code == 200
    assert client.get(f"/v1/history/{ask(client, body)}").status_code == 200


@pytest.mark.parametrize("name", ["history.sqlite", "history.sqlite-wal"])
@pytest.mark.parametrize("replaced", [False, True])
def test_nothing_is_acknowledged_once_the_database_was_deleted_or_replaced(client, body, folder, name, replaced):
    query = ask(client, body)
    assert client.get(f"/v1/history/{query}").status_code == 200
    data = (folder / name).read_bytes()
    (folder / name).unlink()
    if replaced:
        (folder / f"{name}.new").write_bytes(data)
        (folder / f"{name}.new").rename(folder / name)
    told = problem(client.post("/v1/feedback", json={"query": query, "feedback": "none"}), 500, "failed")
    assert told == (
        f"{folder / 'history.sqlite'} was deleted or replaced while the service ran, so nothing can be stored in it; "
        "start the service again"
    )
    problem(client.get("/v1/history"), 500, "failed")
    later = ask(client, body)  # queries are answered
    client.app.state.service.with_history._writer.submit(int).result()
    assert client.app.state.service.with_history.missing_query_problem(later).detail.endswith("start the service again")


def test_a_database_that_hangs_is_told_and_closing_does_not_wait_for_it(folder, monkeypatch):
    monkeypatch.setattr("retrieval.serve.store._LOCK_S", 0.1)
    with RecordingWriter(folder / "recording", INFO) as writer:
        stored = HistoryWriter(folder, writer, ServiceSettings(index="x"), Metrics())
        with stored.store._lock, pytest.raises(RetrievalError, match="sqlite does not answer"):
            stored.store.names()
        stored.close()


# The rig -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def hanging():
    """A rig that hangs until the event is set."""
    go = threading.Event()
    yield (
        LiveRig({"a": lambda: go.wait(60) and b"picture"}, lambda names: go.wait(60) and GraspResult(names[0], [b"x"])),
        go,
    )
    go.set()


def test_grasps_wait_in_few_places_and_hold_up_no_other_request(index, hanging):
    rig, go = hanging
    with listening(index, rig) as (url, parts), ThreadPoolExecutor(60) as client_threads:
        asked = [client_threads.submit(httpx.post, f"{url}/v1/grasp", timeout=60) for _ in range(60)]
        wait_until(lambda: sum(one.done() for one in asked) == 60 - MAX_RIG_GRASPS)
        refused = [one.result() for one in asked if one.done()]
        for response in refused:
            assert "are held already; come again" in problem(response, 429, "busy")
        frames = [client_threads.submit(httpx.get, f"{url}/v1/sensors/a/frame", timeout=60) for _ in range(10)]
        wait_until(lambda: parts.frames["a"].in_flight == 10)
        for path in ("/healthz", "/v1/catalogue", "/v1/index"):
            assert httpx.get(url + path, timeout=10).status_code == 200
        go.set()
        answered = [one.result() for one in asked if one.result().status_code == 200]
        assert len(answered) == MAX_RIG_GRASPS
        assert [one.result().content for one in frames] == [b"picture"] * 10


def test_a_grasp_and_a_picture_that_hang_end_at_the_deadline(index, hanging):
    rig, _ = hanging
    with listening(index, rig, deadline_s=0.3) as (url, _):
        assert problem(httpx.post(f"{url}/v1/grasp"), 504, "late") == "no answer within 300 ms"
        problem(httpx.get(f"{url}/v1/sensors/a/frame"), 504, "late")
        problem(httpx.post(f"{url}/v1/grasp", params={"object": "nobody's"}), 504, "late")  # the rig is still busy


@pytest.mark.parametrize("error", [StopIteration("x"), SystemExit(1), KeyboardInterrupt(), OSError("unplugged")])
def test_whatever_a_rig_raises_the_next_grasp_is_made(index, error):
    raised = iter([error])

    def close(names):
        for one in raised:
            raise one
        return GraspResult(names[0], [b"x"])

    with listening(index, LiveRig({}, close)) as (url, _):
        assert "the rig could not grasp" in problem(httpx.post(f"{url}/v1/grasp"), 500, "failed")
        assert httpx.post(f"{url}/v1/grasp").status_code == 200


# The end -------------------------------------------------------------------------------------------------------------

HANGS = """
import sys, time
from pathlib import Path
from retrieval.serve.app import create_app
from retrieval.serve.server import serve
from retrieval.serve.service import LiveRig
from retrieval.serve.settings import ServiceSettings
from robot.recording.folder import RecordingWriter

index, folder, where = sys.argv[1:]
hang = lambda *given, **named: time.sleep(10_000)
rig = LiveRig({"a": hang if where == "sensor" else lambda: b"picture"}, hang)
with RecordingWriter(Path(folder) / "recording", {"source": "s", "sensor": "t"}) as recorder:
    app = create_app(ServiceSettings(index=index, port=0, history=Path(folder)), rig, recorder)
    parts = app.state.service
    def started(port):
        opened = parts.generations.current
        if where == "query":
            opened.searcher.query = opened.searcher.query_many = hang
        if where == "page":
            opened.shard.page = hang
        if where == "write":
            parts.keeping.store.keep = hang
        if where == "commit":
            parts.keeping.store._lock.acquire()
        if where == "generation":
            import retrieval.serve.generations
            retrieval.serve.generations.manifest_of = hang
        print(port, flush=True)
    serve(app, started)
"""
REQUESTS = {
    "grasp": ("POST", "/v1/grasp"),
    "sensor": ("GET", "/v1/sensors/a/frame"),
    "stream": ("GET", "/v1/sensors/a/stream"),
    "query": ("POST", "/v1/query"),
    "page": ("GET", "/v1/catalogue"),
    "write": ("POST", "/v1/query"),
    "commit": ("POST", "/v1/query"),
    "generation": ("GET", "/healthz"),
    "headers": None,
}


ENDED = {"stream": {200, None}, "write": {200}, "commit": {200}, "generation": {200}, "headers": set()}
"""What the requests in flight were answered; 503 where the work hangs."""


@pytest.mark.slow
@pytest.mark.parametrize("where", REQUESTS)
def test_sigterm_ends_the_process_within_ten_seconds_whatever_hangs(index, folder, body, where):
    line = [sys.executable, "-c", HANGS, str(index), str(folder), where]
    with (
        subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process,
        ThreadPoolExecutor(4) as client_threads,
        ExitStack() as lines,
    ):
        lines.callback(process.kill)
        url = f"http://127.0.0.1:{int(process.stdout.readline())}"
        answers = []
        if REQUESTS[where] is None:
            host, port = url.removeprefix("http://").split(":")
            lines.enter_context(opened((host, int(port)), 512))
        else:
            answers = [client_threads.submit(status, *REQUESTS[where], url, body) for _ in range(4)]
        time.sleep(1.5)
        began = time.monotonic()
        process.send_signal(signal.SIGTERM)
        process.wait(30)
        assert time.monotonic() - began < 10
        assert {answer.result() for answer in answers} <= ENDED.get(where, {503})


def status(method, path, url, body):
    """The status of an answer; None where it was cut off."""
    try:
        return httpx.request(method, url + path, json=body if path == "/v1/query" else None, timeout=60).status_code
    except httpx.HTTPError:
        return None
