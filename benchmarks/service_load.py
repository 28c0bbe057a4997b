"""The service under load, in ratios of one run.

    python -m benchmarks.service_load [--share 1] [--only NAME ...]

Everything runs against an index of simulated objects, made first, with the shipped checkpoint. The test of the history
uses an index of synthetic objects, whose model starts at once. Small by default; --share 1 runs the full sizes: 20
minutes of load, 100 generations, 20 shutdowns, 1,000 hostile bodies, 1,000 kills.
"""

import argparse
import asyncio
import base64
import gc
import json
import os
import random
import shutil
import signal
import socket
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import httpx
import numpy as np

from retrieval.data.dataset import load_grasps
from retrieval.data.images import encode_image
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.build.build_index import build_index
from retrieval.search.defaults import shipped_model
from retrieval.serve.app import create_app
from retrieval.serve.server import Server, uvicorn_config
from retrieval.serve.settings import ServiceSettings
from retrieval.training.train import train
from robot.recording.folder import RecordingWriter
from robot.sim.rig import SimRig
from tests import synthetic
from tests.conftest import TINY
from tests.hostile_pictures import png_file
from tests.retrieval.serve.test_uploads import HEAD
from tests.serving import command, listening

SEED = 20_000
QUEUE = 8


class LoadFixture:
    """A catalogue of simulated objects, its index, and the body of a query for it."""

    def __init__(self, folder, objects=12):
        self.folder, self.catalogue, self.index = folder, folder / "catalog", folder / "index"
        rig = SimRig(SEED)
        self.names = rig.object_ids(objects)
        for name in self.names:
            self.photograph(rig, name, 2)
        self.spare = rig.object_ids(objects + 1)[-1]
        touched = next(touched for number in range(99) if (touched := rig.press(self.names[0], 500 + number)))
        self.touch = [encode_image(touched[f"touch_{finger}"], ".jpg") for finger in "ab"]  # the format of rigs
        self.body = {"touches": [[base64.b64encode(image).decode() for image in self.touch]]}
        self.rig, self.model = rig, load_checkpoint(shipped_model())
        build_index(self.catalogue, self.model, self.index, quiet=True)

    def photograph(self, rig, name, photos):
        """Write photos of an object into the catalogue."""
        (self.catalogue / name).mkdir(parents=True)
        for number in range(photos):
            rig.prepare(name, number)
            (self.catalogue / name / f"{number}.jpg").write_bytes(
                encode_image(rig.sim_state.current_scene().image("photo"), ".jpg")
            )

    def next_generation(self, index):
        """Add an object or remove it, in turn, and build."""
        if (self.catalogue / self.spare).exists():
            shutil.rmtree(self.catalogue / self.spare)
        else:
            self.photograph(self.rig, self.spare, 1)
        build_index(self.catalogue, self.model, index, quiet=True)


class DrawnQuery:
    """A catalogue of synthetic objects and an untrained but fast model; its index, and the body of a query."""

    def __init__(self, folder):
        objects, self.index = synthetic.make_objects(8, seed=9), folder / "index"
        self.names = [one.object_id for one in objects]
        train(
            synthetic.write_recording(folder / "recording", synthetic.make_objects(12), 3),
            folder / "tiny.safetensors",
            TINY,
            quiet=True,
        )
        catalogue = synthetic.write_catalogue(folder / "catalog", objects)
        build_index(catalogue, load_checkpoint(folder / "tiny.safetensors"), self.index, quiet=True)
        touch = synthetic.write_queries(folder / "touch", objects[:1])[self.names[0]][0]
        self.body = {"touches": [[base64.b64encode(path.read_bytes()).decode() for path in touch]]}


def resident_mb(pid):
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def ms(seconds, quantile=0.5):
    return 1e3 * float(np.quantile(seconds, quantile))


def scaled(fraction, full, least):
    """Return this fraction of the full size, at least `least`."""
    return max(least, round(fraction * full))


def report(name, measured, requirement=""):
    print(f"{name:12} {measured}" + (f"   [required: {requirement}]" if requirement else ""), flush=True)


# Measurements ---------------------------------------------------------------------------------------------------------


def paired(bench, fraction):
    """HTTP and the bare query on the same open index, in turn."""
    with listening(bench.index) as (url, parts), httpx.Client(base_url=url, timeout=60) as client:
        searcher = parts.generations.current.searcher
        bare, http = [], []
        for number in range(10 + scaled(fraction, 400, 50)):
            start = time.perf_counter()
            searcher.query([bench.touch])
            between = time.perf_counter()
            assert client.post("/v1/query", json=bench.body).status_code == 200
            if number >= 10:  # the first queries are warm-up
                bare.append(between - start)
                http.append(time.perf_counter() - between)
    allowed = 1.1 * ms(bare) + 5
    report(
        "paired",
        f"bare p50 {ms(bare):.1f} ms, HTTP p50 {ms(http):.1f} ms: {ms(http) / ms(bare):.2f} x, "
        f"{ms(http) - ms(bare):+.1f} ms; relative to the limit {ms(http) / allowed:.2f}",
        "at most 1.1 x + 5 ms",
    )


async def _load(url, body, clients, seconds, pause_s=0.0):
    """Return the seconds of accepted queries, the seconds of their searches, and the counts of statuses.

    A client pauses between two queries; after 429 it retries when the header says. The clients share the machine with
    the service, so they send prepared bytes over plain connections.
    """
    taken, searches, statuses, until = [], [], Counter(), time.monotonic() + seconds
    request = httpx.Request("POST", f"{url}/v1/query", json=body)
    head = "".join(f"{name}: {value}\r\n" for name, value in request.headers.items())
    data = f"POST /v1/query HTTP/1.1\r\n{head}\r\n".encode() + request.content

    async def query():
        connection = None
        while time.monotonic() < until:
            start = time.perf_counter()
            connection = connection or await asyncio.open_connection(request.url.host, request.url.port)
            status, headers, answer = await _exchange(*connection, data)
            statuses[status] += 1
            if status == 200:
                taken.append(time.perf_counter() - start)
                searches.append(json.loads(answer)["timing_ms"]["total"] / 1e3)
            if headers.get("connection") == "close" or status is None:
                connection[1].close()
                connection = None
            await asyncio.sleep(float(headers["retry-after"]) if status == 429 else pause_s)

    await asyncio.gather(*(query() for _ in range(clients)))
    return taken, searches, statuses


async def _exchange(reader, writer, data):
    """Return status, headers and body of the answer to a request; None if the connection broke."""
    try:
        writer.write(data)
        head = (await reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
        headers = dict(line.lower().split(": ", 1) for line in head[1:] if line)
        body = await reader.readexactly(int(headers["content-length"]))
    except (OSError, asyncio.IncompleteReadError):
        return None, {}, b""
    return int(head[0].split()[1]), headers, body


def clients(bench, fraction):
    """32 clients and 8 clients, in turn, and the waiting times of accepted queries."""
    seconds, rates, statuses, phases = scaled(fraction, 30, 8), {8: [], 32: []}, Counter(), []
    waits, searches = [], []
    options = ("--index", bench.index, "--port", "0", "--no-history", "--queue", QUEUE)
    with command(*options) as (_, url, _):
        asyncio.run(_load(url, bench.body, 1, 2))  # warm-up
        for _ in range(scaled(fraction, 6, 3)):
            phases.append(asyncio.run(_load(url, bench.body, 1, seconds / 4))[1])
            for count in rates:
                taken, searched, counts = asyncio.run(_load(url, bench.body, count, seconds))
                rates[count].append(len(taken) / seconds)
                statuses += counts
            waits, searches = waits + taken, searches + searched
    rate = {count: statistics.mean(values) for count, values in rates.items()}
    bare = [one for phase in phases for one in phase]
    in_a_row = [sum(phase[start : start + QUEUE]) for phase in phases for start in range(len(phase) - QUEUE + 1)]
    single_ms = ms(bare)
    report(
        "clients",
        f"32 clients {rate[32]:.1f}/s, 8 clients {rate[8]:.1f}/s: {rate[32] / rate[8]:.2f} x; accepted of 32, with a "
        f"queue of {QUEUE}: p50 {ms(waits) / single_ms:.1f} x, p95 {ms(waits, 0.95) / single_ms:.1f} x a single bare "
        f"query, {QUEUE} of them in a row are p50 {ms(in_a_row) / single_ms:.1f} x, "
        f"p95 {ms(in_a_row, 0.95) / single_ms:.1f} x; "
        f"bare p50 {single_ms:.1f} ms, p95 {ms(bare, 0.95):.1f} ms, under this load {ms(searches):.1f} ms, "
        f"{ms(searches, 0.95):.1f} ms; statuses {dict(statuses)}",
        f"0.9 x; {QUEUE + 1} x; the rest 429",
    )


def memory(bench, fraction):
    """Memory of the process over minutes of load, with the history enabled."""
    seconds, samples, loads = scaled(fraction, 1200, 40), [], []
    with command("--index", bench.index, "--port", "0", "--history", bench.folder / "history") as (process, url, _):
        asyncio.run(_load(url, bench.body, 8, 30))  # warm-up
        deadline = time.monotonic() + seconds
        load = threading.Thread(target=lambda: loads.append(asyncio.run(_load(url, bench.body, 8, seconds, 0.5))))
        load.start()
        while time.monotonic() < deadline:
            samples.append(resident_mb(process.pid))
            time.sleep(1)
        load.join()
    third = len(samples) // 3
    first, last = statistics.median(samples[:third]), statistics.median(samples[-third:])
    report(
        "memory",
        f"{seconds} s, {len(loads[0][0])} queries stored: first third {first:.0f} MB, last third {last:.0f} MB: "
        f"{last - first:+.1f} MB",
        "flat",
    )


def reloads(bench, fraction):
    """New generations under load: failed requests, and answers that mix two generations."""
    count, own = scaled(fraction, 100, 5), bench.folder / "reloaded"
    shutil.copytree(bench.index, own)
    objects, answers, failures, done = {}, Counter(), [], threading.Event()
    with listening(own, poll_s=0.1) as (url, parts), ThreadPoolExecutor(3) as client_threads:

        def query():
            with httpx.Client(base_url=url, timeout=60) as client:
                while not done.is_set():
                    response = client.post("/v1/query", json={**bench.body, "top": 100, "none_prior": 0.5})
                    if response.status_code != 200:
                        failures.append(response.text)
                        continue
                    answer = response.json()
                    answers[answer["index"]["generation"], answer["index"]["objects"]] += 1
                    # A grasp without contact has no ranking.
                    if answer["results"] and len(answer["results"]) != answer["index"]["objects"]:
                        failures.append(answer)

        running = [client_threads.submit(query) for _ in range(3)]
        for _ in range(count):
            bench.next_generation(own)
            name = (own / "CURRENT").read_text().strip()
            while parts.generations.current.name != name:
                time.sleep(0.02)
            objects[name] = parts.generations.current.searcher.objects.count
        done.set()
        for one in running:
            one.result()
    mixed = sum(
        count
        for (name, objects_shown), count in answers.items()
        if objects.get(name, len(bench.names)) != objects_shown
    )
    report(
        "reloads",
        f"{count} generations loaded, {sum(answers.values())} answers of {len(answers)} generations, "
        f"{len(failures)} failed, {mixed} of two generations",
        "0 failed, 0 mixed",
    )


def ends(bench, fraction):
    """SIGTERM with requests in flight."""
    rounds, lost, answered = scaled(fraction, 20, 3), [], 0
    for _ in range(rounds):
        options = ("--index", bench.index, "--port", "0", "--no-history", "--queue", "32")
        with command(*options) as (process, url, _), ThreadPoolExecutor(8) as client_threads:
            httpx.post(f"{url}/v1/query", json=bench.body, timeout=60)
            sent = threading.Semaphore(0)
            in_flight = [client_threads.submit(_raw_query, url, bench.body, sent) for _ in range(8)]
            for _ in in_flight:
                sent.acquire(timeout=30)
            time.sleep(0.05)  # of the eight, one is processed and the others wait
            process.send_signal(signal.SIGTERM)
            found = [one.result(timeout=60) for one in in_flight]
            code = process.wait(60)
            answered += sum(data.startswith(b"HTTP/1.1 200") and data.endswith(b"}") for data in found)
            lost += [data[:40] for data in found if not data.startswith(b"HTTP/1.1 200")] + [code] * (code != 0)
    report("ends", f"{rounds} SIGTERMs: {answered} of {8 * rounds} in flight answered, lost: {lost[:3]}", "none lost")


def _raw_query(url, body, sent):
    request = httpx.Request("POST", f"{url}/v1/query", json=body)
    head = "".join(f"{name}: {value}\r\n" for name, value in request.headers.items())
    with _line(url) as line:
        line.sendall(f"POST /v1/query HTTP/1.1\r\n{head}connection: close\r\n\r\n".encode() + request.content)
        sent.release()
        data = b""
        with suppress(ConnectionError):
            while more := line.recv(65536):
                data += more
        return data


def _line(url):
    host, port = url.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)), timeout=60)


BODY_S = 0.3
"""Time limit of slow bodies in this benchmark; 10 s by default."""


def hostile(bench, fraction):
    """Junk, decompression bombs, half bodies, slow bodies, wrong types, 2 GB announced."""
    count, draw = scaled(fraction, 1000, 100), random.Random(0)
    kinds = ("junk", "json", "bomb", "half", "slow", "type", "announced", "chunked", "form", "deep")
    taken, wrong, statuses = {kind: [] for kind in kinds}, [], Counter()
    settings = ServiceSettings(index=bench.index, port=0, body_s=BODY_S)
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        _serve(settings, None, writer)
    try:
        url = os.read(reader, 100).decode()
        httpx.post(f"{url}/v1/query", json=bench.body, timeout=60)
        before, peak = resident_mb(child), 0.0
        for number in range(count):
            kind = kinds[number % len(kinds)]
            start = time.perf_counter()
            status = _attack(url, kind, draw)
            taken[kind].append(time.perf_counter() - start)
            statuses[status] += 1
            if status is not None and not 400 <= status < 500:
                wrong.append((kind, status))
            peak = max(peak, resident_mb(child))
        alive = httpx.post(f"{url}/v1/query", json=bench.body, timeout=60).status_code
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    slowest = {kind: round(1e3 * max(found)) for kind, found in taken.items()}
    every = [one for found in taken.values() for one in found]
    report(
        "hostile",
        f"{count} bodies: statuses {dict(statuses)} (None: attacker disconnected first), not 4xx {wrong[:3]}; p99 "
        f"{ms(every, 0.99):.0f} ms, slowest by kind {slowest} ms; memory {peak - before:+.0f} MB; then {alive}",
        f"4xx in under 500 ms (slow bodies have {BODY_S} s here), within 100 MB, alive",
    )


def _attack(url, kind, draw):
    """Return the status of the answer; None if the attacker disconnected."""
    junk = draw.randbytes(draw.choice((0, 10, 10_000, 1_000_000)))
    as_json = {"content-type": "application/json"}
    bomb = base64.b64encode(png_file(draw.randrange(5000, 2**31), draw.randrange(5000, 2**31))).decode()
    whole = {
        "junk": lambda: {"content": junk, "headers": as_json},
        "json": lambda: {"json": {"touches": [[base64.b64encode(junk).decode()] * 2]}},
        "bomb": lambda: {"json": {"touches": [[bomb, bomb]]}},
        "type": lambda: {"content": junk, "headers": {"content-type": draw.choice(("text/xml", "image/png", ""))}},
        "form": lambda: {"files": [("gelsight", ("../../x", junk)) for _ in range(draw.randrange(1, 40))]},
        "deep": lambda: {"content": b"[" * draw.randrange(1, 1_000_000), "headers": as_json},
    }
    if kind in whole:
        return httpx.post(f"{url}/v1/query", timeout=60, **whole[kind]()).status_code
    head = HEAD.format(kind="application/json").encode()
    with _line(url) as line:
        if kind == "announced":
            line.sendall(head + b"content-length: %d\r\n\r\n" % (2 * 2**30))
        elif kind == "chunked":
            with suppress(OSError):
                line.sendall(head + b"transfer-encoding: chunked\r\n\r\n")
                for _ in range(400):
                    line.sendall(b"10000\r\n" + b"x" * 65536 + b"\r\n")
        else:
            line.sendall(head + b"content-length: 1000\r\n\r\n{")
            if kind == "half":
                return None
        try:
            return int(line.recv(65536).split(b" ", 2)[1])
        except (ConnectionError, IndexError):
            return None


def _serve(settings, folder, writer):
    """Serve in a fork, send the address through the pipe, and never return."""
    try:
        recorder = folder and RecordingWriter(folder / "recording", {"source": "feedback", "sensor": "simulated"})
        app = create_app(settings, None, recorder)
        port = lambda bound: os.write(writer, f"http://127.0.0.1:{bound}".encode())  # noqa: E731
        Server(uvicorn_config(app), app.state.service, port).run()
    finally:
        os._exit(0)


def kills(bench, fraction):
    """SIGKILL during feedback; the service is a fork, so that it starts at once."""
    rounds, folder, draw, acknowledged = scaled(fraction, 1000, 20), bench.index.parent / "killed", random.Random(0), []
    gc.freeze()  # otherwise the first collection in a fork copies every page of this process
    for _ in range(rounds):
        reader, writer = os.pipe()
        child = os.fork()
        if not child:
            _serve(ServiceSettings(index=bench.index, port=0, history=folder), folder, writer)
        os.close(writer)
        url = os.read(reader, 100).decode()
        os.close(reader)
        killer = threading.Timer(draw.uniform(0.05, 0.6), os.kill, (child, signal.SIGKILL))
        with httpx.Client(base_url=url, timeout=30) as client, suppress(httpx.HTTPError):
            for number in range(10_000):
                query = client.post("/v1/query", json=bench.body).headers["x-query-id"]
                if not number:
                    killer.start()
                feedback = {"query": query, "feedback": "object", "object_id": bench.names[0]}
                if client.post("/v1/feedback", json=feedback).status_code == 201:
                    acknowledged.append(query)
        killer.join()
        os.waitpid(child, 0)
    with (
        RecordingWriter(folder / "recording", {"source": "feedback", "sensor": "simulated"}) as recorder,
        listening(bench.index, None, recorder, history=folder) as (url, parts),
    ):
        httpx.get(f"{url}/v1/history", timeout=60)
        stored = Counter(name for name, _ in parts.history_writer.store.recordable())
    recorded = Counter(grasp.sequence_id for grasp in load_grasps(folder / "recording"))
    lost = [name for name in acknowledged if stored[name] != 1 or recorded[name] != 1]
    report(
        "kills",
        f"{rounds} SIGKILLs, {len(acknowledged)} feedbacks acknowledged, {len(stored)} stored, {len(recorded)} "
        f"recorded, {len(lost)} lost or duplicated",
        "each exactly once",
    )


PARTS = {one.__name__: one for one in (paired, clients, memory, reloads, ends, hostile, kills)}


def main():
    """Run the requested parts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--share", type=float, default=0.02, help="fraction of the full sizes; 1 takes hours")
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS), help="parts")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        benches = {}
        for name in arguments.only:
            kind = DrawnQuery if name == kills.__name__ else LoadFixture
            if kind not in benches:
                benches[kind] = kind(Path(folder) / kind.__name__)
            PARTS[name](benches[kind], arguments.share)


if __name__ == "__main__":
    sys.exit(main())
