"""Concurrent requests, disconnects, deadlines, new generations of the index, and the shutdown."""

import shutil
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import httpx
import pytest

from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint
from retrieval.serve.service import LiveRig
from tests import synthetic
from tests.serving import command, connect, listening, problem, received, service
from tests.waiting import wait_until


class BlockingEncoder:
    """An encoder that waits for an event, and records the number of grasps of each call."""

    def __init__(self, encoder):
        self.encoder, self.calls, self.go = encoder, [], threading.Event()

    @property
    def name(self):
        return self.encoder.name

    def encode(self, touches):
        self.calls.append(len(touches))
        assert self.go.wait(30)
        return self.encoder.encode(touches)


@contextmanager
def blocked_service(index, **settings):
    """Run a service with a blocked encoder; yield its address, the encoder, its parts and a thread pool."""
    with listening(index, **settings) as (url, parts), ThreadPoolExecutor(16) as client_threads:
        searcher = parts.generations.current
        encoder = searcher.reader.encoder = BlockingEncoder(searcher.reader.encoder)
        try:
            yield url, encoder, parts, client_threads
        finally:
            encoder.go.set()


def post_query(url, body, **options):
    return httpx.post(f"{url}/v1/query", json={**body, **options}, timeout=60)


def test_requests_beyond_the_queue_get_429_and_the_others_are_answered(index, body):
    with blocked_service(index, queue=3) as (url, encoder, parts, client_threads):
        first = [client_threads.submit(post_query, url, body) for _ in range(3)]
        wait_until(lambda: parts.queue.in_flight == 3)
        for _ in range(4):
            refused = post_query(url, body)
            assert problem(refused, 429, "busy") == "3 requests are in flight already. Try again."
            assert refused.headers["retry-after"] == "1"
        assert httpx.get(f"{url}/readyz").status_code == 200  # requests without the model are not delayed
        encoder.go.set()
        assert [one.result().status_code for one in first] == [200] * 3
        assert post_query(url, body).status_code == 200


def test_requests_of_disconnected_clients_are_dropped(index, body):
    with blocked_service(index) as (url, encoder, parts, client_threads):
        first = client_threads.submit(post_query, url, body)
        wait_until(lambda: encoder.calls == [1])
        with connection_that_asks(url, body):
            wait_until(lambda: parts.queue.in_flight == 2)
        wait_until(lambda: parts.queue.in_flight == 1)
        last = client_threads.submit(post_query, url, body)
        wait_until(lambda: parts.queue.in_flight == 2)
        encoder.go.set()
        assert (first.result().status_code, last.result().status_code) == (200, 200)
        assert encoder.calls == [1, 1]


def connection_that_asks(url, body):
    """Return a connection on which a query is sent."""
    request = httpx.Request("POST", f"{url}/v1/query", json=body)
    head = "".join(f"{name}: {value}\r\n" for name, value in request.headers.items())
    return connect(url, f"POST /v1/query HTTP/1.1\r\n{head}connection: close\r\n\r\n".encode() + request.content)


def test_late_requests_are_dropped(index, body):
    with blocked_service(index, deadline_s=0.3) as (url, encoder, parts, client_threads):
        requests = [client_threads.submit(post_query, url, body) for _ in range(3)]
        for one in requests:
            assert problem(one.result(), 504, "late") == "No answer within 300 ms."
        wait_until(lambda: parts.queue.in_flight == 0)  # the late ones are dropped
        encoder.go.set()
        later = []
        wait_until(
            lambda: later.append(post_query(url, body)) or later[-1].status_code == 200
        )  # a busy machine is late
        assert len(encoder.calls) <= 1 + len(later)


@pytest.fixture
def grown(catalogue, index, tmp_path, model):
    """A copy of the index, and a function that builds its next generation with one object more or less, in turn."""
    photos, own = tmp_path / "catalog", tmp_path / "index"
    shutil.copytree(catalogue, photos)
    shutil.copytree(index, own)
    checkpoint, extra = load_checkpoint(model), synthetic.make_objects(1, seed=77)

    def build():
        folder = photos / extra[0].object_id
        if folder.exists():
            shutil.rmtree(folder)
        else:
            synthetic.write_catalogue(photos, extra)
        build_index(photos, checkpoint, own)

    return own, build


def test_a_new_generation_is_served_and_no_answer_mixes_two(grown, body):
    own, build = grown
    objects, ended, failures = {"gen-000001": 8}, threading.Event(), []

    def ask(url):
        while not ended.is_set():
            response = post_query(url, body, top=100)
            document = response.json()
            summary = document["index"]["generation"], document["index"]["objects"], len(document["results"])
            if response.status_code != 200 or summary[1] != summary[2]:
                failures.append(document)
            answers.add(summary[:2])

    answers = set()
    with listening(own, poll_s=0.05) as (url, _), ThreadPoolExecutor(2) as client_threads:
        clients = [client_threads.submit(ask, url) for _ in range(2)]
        for number in (2, 3):
            build()
            objects[f"gen-{number:06}"] = 9 if number == 2 else 8
            wait_until(lambda: any(one[0] == f"gen-{number:06}" for one in list(answers)), 60)  # noqa: B023
        ended.set()
        for one in clients:
            one.result()
    assert not failures
    assert dict(sorted(answers)) == objects


def test_a_broken_generation_leaves_the_previous_one_served(grown, body, caplog):
    own, build = grown
    with listening(own, poll_s=0.05) as (url, _):
        build()
        wait_until(lambda: post_query(url, body).json()["index"]["generation"] == "gen-000002", 60)
        (own / "CURRENT").write_text("gen-000009\n")
        wait_until(lambda: "cannot be opened" in caplog.text, 60)
        time.sleep(0.5)  # ten polls
        assert caplog.text.count("cannot be opened") == 1  # one line in the log, not one per poll
        assert post_query(url, body).json()["index"]["generation"] == "gen-000002"


@pytest.mark.parametrize("sign", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_requests_in_flight_at_the_end_signal_are_answered(index, body, sign, tmp_path):
    with (
        command("--index", index, "--port", "0", "--history", tmp_path / "store") as found,
        ThreadPoolExecutor(8) as client_threads,
    ):
        process, url, _ = found
        post_query(url, body)
        connected = threading.Semaphore(0)

        def ask():
            with connection_that_asks(url, body) as line:
                connected.release()
                return received(line)

        answers = [client_threads.submit(ask) for _ in range(8)]
        for _ in answers:
            connected.acquire(timeout=30)
        process.send_signal(sign)
        responses = [one.result(timeout=60) for one in answers]
        assert process.wait(60) == 0
        assert [data.split(b" ", 2)[1] for data in responses] == [b"200"] * 8
        assert all(data.endswith(b"}") for data in responses)


def test_the_newest_picture_of_a_sensor_is_served(index):
    pictures = iter(range(10**6))
    rig = LiveRig({"a": lambda: b"picture %d" % next(pictures), "b": lambda: 1 / 0})
    with service(index, rig) as client:
        for number in range(2):
            response = client.get("/v1/sensors/a/frame")
            assert (response.content, response.headers["content-type"]) == (b"picture %d" % number, "image/jpeg")
        assert problem(client.get("/v1/sensors/b/frame"), 500, "failed") == "Sensor b: division by zero"
        problem(client.get("/v1/sensors/c/frame"), 404, "unknown")
