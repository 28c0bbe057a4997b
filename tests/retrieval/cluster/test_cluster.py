"""A catalogue on Ray: shards are built, served and searched there; no fault gives a wrong or silently partial result.

One Ray serves all tests of this file: two CPUs, a small object store, 127.0.0.1. Processes are killed and stopped to
simulate lost and hanging machines.
"""

import os
import shutil
import signal
import sys
import threading
import time
from contextlib import suppress
from importlib.util import find_spec

import httpx
import numpy as np
import pytest

import retrieval
from indexes.store.folder import IndexStore
from indexes.store.sharded import read_sharded_manifest
from retrieval.data.catalogue import list_catalogue
from retrieval.errors import IncompleteSearch
from retrieval.indexing.sharded import build_sharded
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.searcher import Searcher
from tests import ray_processes, serving
from tests.retrieval.search.test_shards import names, same_answers
from tests.waiting import first_line, run_process

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore"),  # Ray's own warnings
    pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra `cluster`"),
]

LOOPBACK = {"0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"}
OPENED = []
SHARD, WORKER = r"ray::ServeReplica:shard-", r"ray::MapWorker"


@pytest.fixture(scope="module")
def ray():
    from retrieval.cluster.session import ray_session

    with ray_session() as module:
        yield module
        for opened in OPENED:
            opened.close()


def deployments(ray, **settings):
    from retrieval.cluster.serving import Deployments, ReplicaSettings

    OPENED.append(Deployments(ray, ReplicaSettings(cpus=0.1, **settings)))
    return OPENED[-1]


@pytest.fixture(scope="module")
def served(ray, cluster):
    """The sharded index, served by Ray; a query must search all of it within two minutes."""
    with Searcher.open(cluster, shards=deployments(ray, wait_s=120.0).open) as searcher:
        yield searcher


@pytest.mark.parametrize("count", [1, 3])
def test_results_equal_those_of_the_folder(count, served, searcher, grasps):
    for own in grasps:
        same_answers(served.query(own[:count]), searcher.query(own[:count]))


HOLDING = """
import sys, time
from retrieval.cluster.serving import Deployments, ReplicaSettings
from retrieval.cluster.session import ray_session
from retrieval.search.searcher import Searcher
with ray_session() as ray:
    searcher = Searcher.open(sys.argv[1], shards=Deployments(ray, ReplicaSettings(cpus=0.1)).open)
    print("ready", flush=True)
    time.sleep(600)
"""


def test_shards_of_a_killed_process_are_deleted_by_the_next(ray, cluster, served, grasps, monkeypatch):
    before = set(ray.serve.status().applications)
    monkeypatch.setenv("RAY_ADDRESS", ray.get_runtime_context().gcs_address)
    with run_process([sys.executable, "-W", "ignore", "-c", HOLDING, str(cluster)]) as process:
        assert first_line(process, 240) == "ready\n"
        orphans = set(ray.serve.status().applications) - before
        process.kill()
        process.wait(60)
    assert len(orphans) == 4
    deadline = time.monotonic() + 120  # until Ray has noticed
    while orphans & set(ray.serve.status().applications) and time.monotonic() < deadline:
        deployments(ray).close()
        time.sleep(0.5)
    assert not orphans & set(ray.serve.status().applications)
    assert before <= set(ray.serve.status().applications)
    assert served.query(grasps[0]).results


def test_a_killed_shard_is_restarted_and_every_result_is_complete(served, grasps):
    expected = names(served.query(grasps[0]))
    for turn in range(20):
        process = ray_processes.processes_named(SHARD)[turn % len(ray_processes.processes_named(SHARD))]
        os.kill(process, signal.SIGKILL)
        assert names(served.query(grasps[0])) == expected


def test_a_shard_that_hangs_is_reported(ray, cluster, grasps):
    searcher = Searcher.open(cluster, shards=deployments(ray, wait_s=2.0).open)
    assert searcher.query(grasps[0]).results
    stopped = ray_processes.processes_named(f"{SHARD}00-of-04")
    for process in stopped:
        os.kill(process, signal.SIGSTOP)
    try:
        with pytest.raises(IncompleteSearch, match=r"no answer within 2 s from shard-0\d-of-04"):
            searcher.query(grasps[0])
    finally:
        for process in stopped:
            with suppress(ProcessLookupError):  # Ray has replaced it
                os.kill(process, signal.SIGCONT)


def test_a_new_generation_is_used_during_running_queries(ray, catalogue, cluster, model, grasps, tmp_path):
    shutil.copytree(catalogue, tmp_path / "catalog")
    shutil.copytree(cluster, tmp_path / "cluster")
    served = deployments(ray, wait_s=120.0)
    current, reports, stop = [Searcher.open(tmp_path / "cluster", shards=served.open)], [], threading.Event()

    def run_queries():
        while not stop.is_set():
            answer = current[0].query(grasps[0], top=1)
            reports.append((answer.index["generation"], answer.index["photos"]))

    thread = threading.Thread(target=run_queries)
    thread.start()
    try:
        name = min(path.name for path in (tmp_path / "catalog").iterdir())
        shutil.copy(next(catalogue.glob("*/2.jpg")), tmp_path / "catalog" / name / "new.jpg")
        build_sharded(tmp_path / "catalog", load_checkpoint(model), tmp_path / "cluster", 4)
        before = current[0]
        current[0] = Searcher.open(tmp_path / "cluster", shards=served.open)
        del before
        count, deadline = len(reports), time.monotonic() + 120
        while len(reports) < count + 3 and time.monotonic() < deadline:
            time.sleep(0.05)
    finally:
        stop.set()
        thread.join(300)
    assert set(reports) == {("sharded-000001", 24), ("sharded-000002", 25)}
    assert reports == sorted(reports)


def partials_of(cluster):
    """{photo: its partial activation} of all shards."""
    found = {}
    for entry in read_sharded_manifest(cluster).shards:
        generation = IndexStore(cluster / entry.folder).open(name=entry.generation)
        found |= {
            row.path: partial.tobytes()
            for row, partial in zip(generation.rows, generation.arrays["partials"], strict=True)
        }
    return found


def test_shards_built_by_ray_equal_those_built_in_process(ray, catalogue, cluster, model, tmp_path):
    from retrieval.cluster.building import build_on_ray

    report = build_sharded(catalogue, load_checkpoint(model), tmp_path / "c", 4, run=build_on_ray)
    assert (report.photos, report.embedded, len(report.shards)) == (24, 24, 4)
    assert ray.is_initialized()  # an existing session stays open
    ours, theirs = partials_of(tmp_path / "c"), partials_of(cluster)
    assert ours.keys() == theirs.keys()
    for name, partial in ours.items():
        np.testing.assert_allclose(
            np.frombuffer(partial, np.float16), np.frombuffer(theirs[name], np.float16), atol=2e-3
        )


@pytest.fixture
def many(catalogue, tmp_path):
    """A catalogue of 240 different photos of 40 objects."""
    data = min(catalogue.rglob("*.jpg")).read_bytes()
    for number in range(240):
        place = tmp_path / "many" / f"object-{number % 40:02d}" / f"{number}.jpg"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(data + b"\0" + str(number).encode())  # different content; decoders stop at the end marker
    return tmp_path / "many"


def test_a_killed_worker_loses_nothing_and_repeats_little(ray, many, model, tmp_path):
    """Codes are stored immediately: only photos in work of the killed process are embedded twice."""
    from retrieval.cluster.building import build_on_ray

    done = {}

    def build():
        done["report"] = build_sharded(many, load_checkpoint(model), tmp_path / "c", 3, run=build_on_ray)

    thread = threading.Thread(target=build)
    thread.start()
    deadline, killed = time.monotonic() + 240, 0
    while thread.is_alive() and killed < 2 and time.monotonic() < deadline:
        records = sum(path.stat().st_size for path in (tmp_path / "c").glob("shard-*/codes/cache.sqlite"))
        if records and (workers := ray_processes.processes_named(WORKER)):
            os.kill(workers[0], signal.SIGKILL)
            killed += 1
            time.sleep(2)
        time.sleep(0.002)
    thread.join(600)
    report = done["report"]
    assert killed
    assert (report.photos, report.objects, report.skipped) == (240, 40, [])
    assert len(partials_of(tmp_path / "c")) == 240 == len(list_catalogue(many).photos)


def test_the_service_on_a_cluster_gives_the_results_of_the_folder_and_restarts_after_a_kill(cluster, searcher, touch):
    """Without RAY_ADDRESS the service starts its own Ray, which ends with it and listens only on this machine."""
    expected = searcher.query(touch)
    for how in (signal.SIGKILL, signal.SIGTERM):
        with serving.command("--index", cluster, "--cluster", "--no-history", "--port", 0) as (process, address, _):
            client = retrieval.Client(address)
            answer = client.query(touch)
            same_answers(answer, expected)
            assert answer.index["shards"] == 4
            found = httpx.get(f"{address}/v1/catalogue", params={"limit": 500}).json()
            assert {item["id"] for item in found["items"]} == {row.path for row in searcher.generation.rows}
            assert httpx.get(f"{address}/v1/photos/{answer.top.photo}").status_code == 200
            below = ray_processes.descendants(process.pid)
            assert ray_processes.listening_addresses(process.pid) <= LOOPBACK
            process.send_signal(how)
            assert process.wait(120) == (0 if how == signal.SIGTERM else -signal.SIGKILL)
        deadline = time.monotonic() + 240  # an agent of Ray checks from time to time whether its raylet is alive
        while (remaining := set(below) & set(ray_processes.parents())) and time.monotonic() < deadline:
            time.sleep(0.2)
        assert not remaining
