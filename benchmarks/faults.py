"""`python -m benchmarks.faults [--times 20] [--only NAME ...]`: faults of a sharded index, and their consequences.

    router      the service is killed during queries, and started again
    shard       the process of a shard is killed during queries
    worker      a process of Ray Data is killed while it embeds
    job         a build from and into an object store is killed about halfway, and run again: on the same machine, and
                on another one, which has only the store
    refusals    the store refuses one request of twenty
    torn        of one upload in five, only half arrives

After each fault, every photo must be present once with the code of an undisturbed build, and every answer must be
complete and right. It prints a line of figures for each kind and exits with code 1 if something was lost, duplicated or
wrong.
"""

import argparse
import json
import mmap
import os
import random
import shutil
import signal
import struct
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from functools import cached_property
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from indexes.errors import NoIndex
from indexes.store.folder import IndexStore
from retrieval.errors import RetrievalError
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.query.searcher import Searcher
from retrieval.search.sharding.build_sharded import build_sharded
from retrieval.search.sharding.object_store import local_folder, read_sharded_manifest
from tests import ray_processes, s3, serving, synthetic

PHOTOS, OBJECTS, SHARDS, BLOCKS = 240, 40, 4, 8
ATOL = 2e-3
"""Tolerance between partial activations (float16), and their logits, that were encoded in batches of another size."""
SHARD, WORKER = r"ray::ServeReplica:shard-", r"ray::MapWorker"


class ExpectationFailed(Exception):
    """Something was lost, duplicated, or answered wrongly."""


def require(holds, what):
    """Raise ExpectationFailed unless `holds`."""
    if not holds:
        raise ExpectationFailed(what)


def write_photos(folder, photos=PHOTOS, objects=OBJECTS):
    """Write a catalogue of this many synthetic photos, no two alike."""
    return synthetic.write_catalogue(folder, synthetic.make_objects(objects, seed=9), photos // objects)


def _make(folder):
    """Train the checkpoint for six steps, in a separate process: the parent forks later and must have no threads."""
    from retrieval.training.train import train
    from tests.conftest import TINY

    recording = synthetic.write_recording(folder / "recording", synthetic.make_objects(12), 3)
    train(recording, folder / "tiny.safetensors", TINY, quiet=True)


class FaultFixture:
    """Photos, model, an undisturbed sharded index, and touches with its answers."""

    def __init__(self, folder, seed=0):
        self.folder, self.rng = folder, random.Random(seed)
        process = get_context("spawn").Process(target=_make, args=(folder,))
        process.start()
        process.join()
        self.model = folder / "tiny.safetensors"
        self.photos = write_photos(folder / "photos")
        self.cluster = folder / "cluster"
        self.forked(lambda: self.build(self.photos, self.cluster)).join()
        objects = synthetic.make_objects(3, seed=9)
        drawn = synthetic.write_queries(folder / "touches", objects)
        self.touches = [pair for pairs in drawn.values() for pair in pairs]
        self.codes = self.codes_of(self.cluster)
        require(len(self.codes) == PHOTOS, "the undisturbed build does not have all photos")
        with Searcher.open(self.cluster) as searcher:
            self.expected = [logits(searcher.query(touch, top=OBJECTS)) for touch in self.touches]

    def build(self, photos, out, shards=SHARDS, **how):
        """Build in this process."""
        return build_sharded(photos, load_checkpoint(self.model), out, shards, quiet=True, **how)

    @staticmethod
    def forked(work):
        """Start a process that does this work and ends."""
        process = get_context("fork").Process(target=work)
        process.start()
        return process

    def codes_of(self, cluster):
        """Return {photo: (object, partial activation)} of all shards; no photo may be in two of them."""
        found = {}
        for entry in read_sharded_manifest(cluster).shards:
            store = IndexStore(local_folder(cluster, entry) / entry.folder)
            generation = store.open(name=entry.generation)
            for row, partial_activation in zip(generation.rows, generation.arrays["partials"], strict=True):
                require(row["id"] not in found, f"{row['id']} is present twice")
                found[row["id"]] = row["object_id"], partial_activation.astype(np.float32)
        return found

    def check_codes(self, cluster):
        """Require all photos, once, with the codes of the undisturbed build."""
        found = self.codes_of(cluster)
        require(found.keys() == self.codes.keys(), f"{len(found)} of {len(self.codes)} photos are present")
        for name, (owner, partial_activation) in found.items():
            require(owner == self.codes[name][0], f"{name} belongs to {owner}")
            require(np.allclose(partial_activation, self.codes[name][1], atol=ATOL), f"{name} has another code")

    def check_answer(self, number, answer):
        """Require a complete answer, equal to that of the undisturbed index."""
        require(answer.index["searched"] == 1.0, f"only {answer.index['searched']} was searched")
        found, expected = logits(answer), self.expected[number]
        best = sorted(expected.values(), reverse=True)[: len(found)]
        right = len(found) == 10 and np.allclose(list(found.values()), best, atol=ATOL)
        right = right and all(abs(logit - expected[name]) <= ATOL for name, logit in found.items())
        require(right, f"touch {number} is answered by {found}")

    def check_answers(self, cluster):
        """Check the answers to all touches."""
        with Searcher.open(cluster) as searcher:
            for number, touch in enumerate(self.touches):
                self.check_answer(number, searcher.query(touch))

    @cached_property
    def stored(self):
        """URL of the photos in an object store."""
        s3.put(self.photos, "faults/photos")
        return "s3://faults/photos"


def logits(answer):
    """Return {object: logit}, best first; batches of another size change logits slightly, and the order of ties."""
    return {match.object_id: match.logit for match in answer.results}


def clear_cache():
    """Delete the cache, so that this machine behaves like another one."""
    shutil.rmtree(Path(os.environ["XDG_CACHE_HOME"]), ignore_errors=True)


class EncodedPhotoCount:
    """Count the photos that processes forked from this one encode, while the context is active."""

    def __enter__(self):
        from retrieval.model import photo_encoder

        self._shared, self._plain = mmap.mmap(-1, 8), photo_encoder.encode_photos

        def counted(matcher, photos, batch):
            photos = list(photos)
            encoding = self._plain(matcher, photos, batch)
            self.set(self.count + len(photos))
            return encoding

        photo_encoder.encode_photos = counted
        return self

    def __exit__(self, *_):
        from retrieval.model import photo_encoder

        photo_encoder.encode_photos = self._plain

    @property
    def count(self):
        """The count so far."""
        return struct.unpack("q", self._shared[:8])[0]

    def set(self, count):
        """Set the count."""
        self._shared[:8] = struct.pack("q", count)


# Builds ---------------------------------------------------------------------------------------------------------------


def job(bench, times):
    """Kill a build after 40 to 60 % of the photos. Another machine repeats only a block: one of 8 shards."""
    figures = {"killed": 0}
    with s3.run_server(), EncodedPhotoCount() as encoded:
        for where in ("same", "other"):
            repeated, fractions = [], []
            for turn in range(times):
                clear_cache()
                url, aim = f"s3://faults/{where}-{turn}", bench.rng.uniform(0.4, 0.6) * PHOTOS
                encoded.set(0)
                process = bench.forked(lambda url=url: bench.build(bench.stored, url, BLOCKS))
                while process.is_alive() and encoded.count < aim:
                    time.sleep(0.001)
                time.sleep(bench.rng.uniform(0, 0.05))
                process.kill()
                process.join()
                figures["killed"] += process.exitcode == -signal.SIGKILL
                done = encoded.count
                try:
                    read_sharded_manifest(url)
                    require(process.exitcode == 0, "a killed build wrote the manifest of the sharded index")
                except NoIndex:
                    pass
                if where == "other":
                    clear_cache()
                process = bench.forked(lambda url=url: bench.build(bench.stored, url, BLOCKS))
                process.join()
                require(process.exitcode == 0, "the next build failed")
                repeated.append(encoded.count - PHOTOS)
                if done < PHOTOS:
                    fractions.append(repeated[-1] / (PHOTOS - done))
                bench.check_codes(url)
                bench.check_answers(url)
            figures |= {f"{where}_repeated_mean": float(np.mean(repeated)), f"{where}_repeated_most": max(repeated)}
            figures |= {
                f"{where}_of_the_rest_p50": float(np.median(fractions)),
                f"{where}_of_the_rest_most": max(fractions),
            }
    return figures


def disturbed(bench, times, kind, **faults):
    """Build into a store with faults and search it, until there were enough faults; at least a few builds."""
    builds = 0
    with s3.run_server() as server:
        photos = bench.stored
        for name, every in faults.items():
            setattr(server, name, every)
        while getattr(server, kind) < times or builds < max(2, times // 4):
            clear_cache()
            url = f"s3://faults/{kind}-{builds}"
            process = bench.forked(lambda url=url: bench.build(photos, url))
            process.join()
            require(process.exitcode == 0, "the build failed")
            clear_cache()
            bench.check_codes(url)
            bench.check_answers(url)
            builds += 1
        return {kind: getattr(server, kind), "requests": server.requests, "uploads": server.uploads, "builds": builds}


def refusals(bench, times):
    """Refuse one request of twenty."""
    return disturbed(bench, times, "refused", refuse=20)


def torn(bench, times):
    """Truncate one upload of five."""
    return disturbed(bench, times, "torn", tear=5)


def worker(bench, times):
    """Kill the workers whenever new codes were stored, at most four times per build."""
    from retrieval.cluster.building import ray_runner

    killed = builds = 0
    while killed < times:
        out, done = bench.folder / f"by-ray-{builds}", {}

        def work(out=out, done=done):
            done["report"] = bench.build(bench.photos, out, run=ray_runner(2, workers=1), max_unreadable=0)

        thread, known, own = threading.Thread(target=work), 0, 0
        thread.start()
        while thread.is_alive():
            stored = sum(path.stat().st_size for path in out.glob("shard-*/unfinished.sqlite"))
            if stored > known and own < min(4, times - killed) and (workers := ray_processes.processes_named(WORKER)):
                for process in workers:
                    os.kill(process, signal.SIGKILL)
                own, known = own + 1, stored
            known = min(known, stored)  # a finished shard has no such file
            time.sleep(0.002)
        thread.join()
        require("report" in done, "the build failed")
        bench.check_codes(out)
        bench.check_answers(out)
        killed, builds = killed + own, builds + 1
    return {"killed": killed, "builds": builds}


# Answers --------------------------------------------------------------------------------------------------------------


@contextmanager
def queried(bench, query):
    """Send queries one after the other in a thread while the block runs; yield {"answers", "errors", "wrong"}."""
    tally, stop = {"answers": 0, "errors": 0, "wrong": []}, threading.Event()

    def run():
        number = 0
        while not stop.is_set():
            number = (number + 1) % len(bench.touches)
            try:
                answer = query(bench.touches[number])
                bench.check_answer(number, answer)
                tally["answers"] += 1
            except RetrievalError:  # reported to the client
                tally["errors"] += 1
                time.sleep(0.05)
            except ExpectationFailed as error:
                tally["wrong"].append(str(error))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield tally
    finally:
        stop.set()
        thread.join()
        require(not tally["wrong"], "; ".join(tally["wrong"][:3]))


def wait_for(tally, name="answers", by=1, limit_s=240):
    """Wait until the count has grown by this much."""
    start, until = tally[name], time.monotonic() + limit_s
    while tally[name] < start + by and not tally["wrong"]:
        require(time.monotonic() < until, f"no {name} within {limit_s} s")
        time.sleep(0.005)


def shard(bench, times):
    """Kill shards during queries."""
    from retrieval.cluster.serving import Deployments, ReplicaSettings
    from retrieval.cluster.session import ray_session

    with ray_session(2) as ray:
        deployments = Deployments(ray, ReplicaSettings(cpus=0.1, wait_s=120.0))
        with Searcher.open(bench.cluster, shards=deployments.open) as searcher, queried(bench, searcher.query) as tally:
            wait_for(tally)
            for turn in range(times):
                processes = ray_processes.processes_named(SHARD)
                os.kill(processes[turn % len(processes)], signal.SIGKILL)
                wait_for(tally, by=3)
            return {"killed": times, "answers": tally["answers"], "errors": tally["errors"]}


def router(bench, times):
    """Kill the service with its own Ray."""
    from retrieval import Client

    answers = errors = 0
    options = ["--index", bench.cluster, "--cluster", "--no-history", "--port", 0]
    for _ in range(times):
        with serving.command(*options) as (process, address, _), Client(address) as client:
            with queried(bench, client.query) as tally:
                wait_for(tally, by=2)
                process.kill()
                wait_for(tally, "errors")
            answers, errors = answers + tally["answers"], errors + tally["errors"]
    return {"killed": times, "answers": answers, "errors": errors}


KINDS = {one.__name__: one for one in (refusals, torn, job, worker, shard, router)}


def main():
    """Print a line of figures for each kind."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults", description=__doc__.split("\n\n")[0])
    parser.add_argument("--times", type=int, default=20, help="repetitions of each fault")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS), metavar="NAME", help=", ".join(KINDS))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        os.environ["XDG_CACHE_HOME"], os.environ["XDG_STATE_HOME"] = f"{name}/cache", f"{name}/state"
        bench, failed = FaultFixture(Path(name), arguments.seed), 0
        for kind in arguments.only:
            start = time.monotonic()
            try:
                figures = KINDS[kind](bench, arguments.times)
            except ExpectationFailed as error:
                figures, failed = {"wrong": str(error)}, 1
            minutes = round((time.monotonic() - start) / 60, 1)
            print(json.dumps({"kind": kind, **figures, "minutes": minutes}), flush=True)
        return failed


if __name__ == "__main__":
    sys.exit(main())
