"""Failures of a service: a hanging rig, query or disk. A full disk is in test_history.py."""

import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from retrieval.serve.service import MAX_RIG_GRASPS, GraspResult, LiveRig
from tests.serving import listening, problem
from tests.waiting import wait_until


@pytest.fixture
def hanging():
    """A rig that hangs until the event is set."""
    go = threading.Event()
    yield (
        LiveRig({"a": lambda: go.wait(60) and b"picture"}, lambda names: go.wait(60) and GraspResult(names[0], [b"x"])),
        go,
    )
    go.set()


def test_pending_grasps_are_limited_and_block_no_other_request(index, hanging):
    rig, go = hanging
    with listening(index, rig) as (url, parts), ThreadPoolExecutor(24) as client_threads:
        requests = [client_threads.submit(httpx.post, f"{url}/v1/grasp", timeout=60) for _ in range(12)]
        wait_until(lambda: sum(one.done() for one in requests) == 12 - MAX_RIG_GRASPS)
        refused = [one.result() for one in requests if one.done()]
        for response in refused:
            assert "are in flight already. Try again." in problem(response, 429, "busy")
        frames = [client_threads.submit(httpx.get, f"{url}/v1/sensors/a/frame", timeout=60) for _ in range(10)]
        wait_until(lambda: parts.frames["a"].in_flight == 10)
        for path in ("/healthz", "/v1/catalogue", "/v1/index"):
            assert httpx.get(url + path, timeout=10).status_code == 200
        go.set()
        answered = [one.result() for one in requests if one.result().status_code == 200]
        assert len(answered) == MAX_RIG_GRASPS
        assert [one.result().content for one in frames] == [b"picture"] * 10


def test_a_grasp_and_a_picture_that_hang_end_at_the_deadline(index, hanging):
    rig, _ = hanging
    with listening(index, rig, deadline_s=0.3) as (url, _):
        assert problem(httpx.post(f"{url}/v1/grasp"), 504, "late") == "No answer within 300 ms."
        problem(httpx.get(f"{url}/v1/sensors/a/frame"), 504, "late")
        problem(httpx.post(f"{url}/v1/grasp", params={"object": "nobody's"}), 504, "late")  # the rig is still busy


def test_the_next_grasp_succeeds_after_any_exception_of_the_rig(index):
    raised = iter([OSError("unplugged")])

    def close(names):
        for one in raised:
            raise one
        return GraspResult(names[0], [b"x"])

    with listening(index, LiveRig({}, close)) as (url, _):
        assert "The rig could not grasp" in problem(httpx.post(f"{url}/v1/grasp"), 500, "failed")
        assert httpx.post(f"{url}/v1/grasp").status_code == 200


HANGS = """
import sys, time
from pathlib import Path
from retrieval.serve.app import create_app
from retrieval.serve.server import serve
from retrieval.serve.service import LiveRig
from retrieval.serve.settings import ServiceSettings
from robot.recording.folder import RecordingWriter

index, folder, where = sys.argv[1:]
hang = lambda *args, **keywords: time.sleep(10_000)
with RecordingWriter(Path(folder) / "recording", {"source": "s", "sensor": "t"}) as recorder:
    settings = ServiceSettings(index=Path(index), port=0, history=Path(folder))
    app = create_app(settings, LiveRig({}, hang), recorder)
    parts = app.state.service
    def on_started(port):
        if where == "query":
            parts.generations.current.query = hang
        if where == "write":
            parts.history_writer.store.add_query = hang
        print(port, flush=True)
    serve(app, on_started)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("where", "path"), [("rig", "grasp"), ("query", "query"), ("write", "query")])
def test_sigterm_ends_the_process_whatever_hangs(index, tmp_path, body, where, path):
    line = [sys.executable, "-c", HANGS, str(index), str(tmp_path), where]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process, ThreadPoolExecutor(4) as client_threads:
        try:
            url = f"http://127.0.0.1:{int(process.stdout.readline())}/v1/{path}"
            answers = [
                client_threads.submit(httpx.post, url, json=body if path == "query" else None, timeout=60)
                for _ in range(4)
            ]
            time.sleep(1.5)
            process.send_signal(signal.SIGTERM)
            process.wait(60)
            assert {answer.result().status_code for answer in answers} == {503}
        finally:
            process.kill()
