"""`python -m benchmarks.shards [--sizes 1e4 1e5 1e6] [--shards 8] [--ray] [--json]`: one folder against shards.

Catalogues are drawn as in `benchmarks.scale`, blended from the codes of synthetic pictures; the touches are those
stored in the checkpoint. Each catalogue is written as one index folder and as a sharded index, and both are searched in
turn, in this process, by one thread: agreement of the top-1, time of a shard, and memory of both. Last, the time that a
client needs to open the sharded index, its manifest and the model, without a shard of its own: for all sizes, in turn.
With --ray, Ray Serve runs a sharded index of one shard: the round trip, compared with the folder.

Run it on one thread (OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1). A million photos take 3 GB on disk.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.scale import BlendedPhotos
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from indexes.store.sharded import (
    ShardedManifest,
    ShardEntry,
    open_shard,
    read_sharded_manifest,
    shard_entry,
    shard_folder,
    shard_number,
    sharded_generation_name,
    write_sharded_manifest,
)
from indexes.store.tables import Block
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.checkpoint_info import fingerprint, read_checkpoint_info
from retrieval.model.fusion import scorer_of
from retrieval.search.defaults import shipped_model
from retrieval.search.embeddings import embed_photos
from retrieval.search.query.opening import folder_shard, open_sharded_index
from retrieval.search.query.shard import FolderShard, Shard, ShardQuery
from tests import synthetic

TOUCHES, OPENINGS = 200, 21
BLOCK = 10_000
CANDIDATES = 5300
"""Candidates that contain 99 % of the top-1s of a million photos; for other sizes N^0.8 (docs/performance.md)."""
OPEN_PROBE = """
import sys, time
from pathlib import Path
from indexes.store.sharded import read_sharded_manifest
from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.search.query.opening import sharded_index_info
start = time.process_time()
manifest = read_sharded_manifest(Path(sys.argv[1]))
info = sharded_index_info(manifest)
read_checkpoint_info(Path(sys.argv[2]))
print(time.process_time() - start, info.photos)
"""
MEMORY_PROBE = """
import sys
from pathlib import Path
from retrieval.search.query.searcher import Searcher
def anonymous():
    return int(next(line for line in open("/proc/self/status") if line.startswith("RssAnon")).split()[1])
searcher = Searcher.open(sys.argv[1], verify=False)
searcher.encoder = searcher.reader = None
import numpy as np, gc
from retrieval.search.query.shard import ShardQuery
codes = np.load(sys.argv[2])
before = anonymous()
searcher.shard.search(ShardQuery(codes["embeddings"][:1], codes["partials"][:1]), 10, None, searcher.posterior)
print(anonymous() / 1024, (anonymous() - before) / 1024)
"""


def candidates_of(photos: int) -> int:
    """Return the number of candidates for this many photos."""
    return max(100, round(CANDIDATES * (photos / 1e6) ** 0.8))


def drawn_photos(checkpoint: Checkpoint, objects: int = 60) -> BlendedPhotos:
    """Return the codes of pictures of synthetic objects, to blend photos from."""
    with tempfile.TemporaryDirectory() as name:
        folder = synthetic.write_catalogue(Path(name) / "catalog", synthetic.make_objects(objects))
        codes = embed_photos(sorted(folder.rglob("*.jpg")), model=checkpoint)
    touches = checkpoint.queries.astype(np.float32)
    return BlendedPhotos(checkpoint, scorer_of(checkpoint.matcher.head), codes.partials, touches, held_out=touches[:0])


def write(crowd: BlendedPhotos, photos: int, shards: int, out: Path) -> dict[str, float]:
    """Write the catalogue as one folder, `out`/index, and as shards, `out`/cluster; return seconds and bytes."""
    model = crowd.checkpoint
    about = {"checkpoint": str(model.path.resolve()), "catalogue": "/drawn", "cells": False}
    calibration = {"calibration": model.posterior.to_dict()} if model.posterior else {}
    options: dict[str, Any] = {"fingerprint": fingerprint(model), "self_check": 16, "threads": 1}
    start = time.perf_counter()
    measured = {"candidates": {"k": candidates_of(photos)}}
    whole = IndexStore(out / "index").write_blocks(
        crowd.blocks(0, photos, 0), calibration, about=about | measured, **options
    )
    folder_s = time.perf_counter() - start
    measured = {"candidates": {"k": candidates_of(photos // shards)}}
    entries, start = list[ShardEntry](), time.perf_counter()
    places = np.array([shard_number(row["object_id"], shards) for row in whole.rows])
    for number in range(shards):
        name = shard_folder(number, shards)
        blocks = _blocks_of(whole, np.flatnonzero(places == number))
        made = IndexStore(out / "cluster" / name).write_blocks(blocks, calibration, about=about | measured, **options)
        entries.append(shard_entry(out / "cluster", name, made, len(np.unique(made.codes("object_id")))))
    manifest = ShardedManifest(
        sharded_generation_name(1),
        "",
        "",
        "flat",
        fingerprint(model),
        about,
        calibration.get("calibration"),
        shards,
        entries,
    )
    write_sharded_manifest(out / "cluster", manifest)
    size = sum(seal.bytes for seal in whole.manifest.files.values())
    return {"folder_s": folder_s, "shards_s": time.perf_counter() - start, "bytes_per_photo": size / photos}


def _blocks_of(whole: Generation, rows: NDArray[np.int64]) -> Iterator[Block]:
    for some in np.array_split(rows, -(-len(rows) // BLOCK)):
        partials = whole.arrays["partials"][some]
        yield Block([whole.rows[row] for row in some], whole.embeddings[whole.slots[some]], {"partials": partials})


def compare(crowd: BlendedPhotos, folder: Shard, cluster: Shard, touches: int, reranked: int) -> dict[str, float]:
    """Search both in turn; return the agreement of the top-1, with candidates and with all photos scored, and times."""
    partials = crowd.touches[:touches]
    embeddings = crowd.embeddings(partials, "touch")
    posterior, photos = crowd.checkpoint.posterior, folder.info.photos
    same = better = 0
    times: dict[str, list[float]] = {"folder": [], "shards": [], "slowest": [], "search": [], "rerank": []}
    for number in range(len(partials)):
        query, k = ShardQuery(embeddings[number : number + 1], partials[number : number + 1]), candidates_of(photos)
        start = time.thread_time()
        from_folder = folder.search(query, 10, k, posterior)
        middle = time.thread_time()
        from_shards = cluster.search(query, 10, k, posterior)
        times["folder"].append(middle - start)
        times["shards"].append(time.thread_time() - middle)
        single = cluster.shards[number % len(cluster.shards)]  # type: ignore[attr-defined]
        start = time.thread_time()
        result = single.search(query, 10, None, posterior)
        times["slowest"].append(time.thread_time() - start)
        times["search"].append(result.timing_ms["candidates"] / 1e3)
        times["rerank"].append(result.timing_ms["rerank"] / 1e3)
        same += from_folder.best[0].photo == from_shards.best[0].photo
        better += from_shards.best[0].logit >= from_folder.best[0].logit - 1e-5
    exact, exhaustive_top1, error, exhaustive_s = 0, 0, 0.0, list[list[float]]()
    for number in range(reranked):
        query = ShardQuery(embeddings[number : number + 1], partials[number : number + 1])
        start = time.thread_time()
        from_folder = folder.search(query, 10, photos, posterior)
        middle = time.thread_time()
        from_shards = cluster.search(query, 10, photos, posterior)
        exhaustive_s.append([middle - start, time.thread_time() - middle])
        exhaustive_top1 += from_folder.best[0].photo == from_shards.best[0].photo
        exact += [each.photo for each in from_folder.best] == [each.photo for each in from_shards.best]
        error = max(error, *(abs(a.logit - b.logit) for a, b in zip(from_folder.best, from_shards.best, strict=True)))
        if posterior is not None and from_folder.mass is not None and from_shards.mass is not None:
            ours, theirs = (
                posterior.probabilities_given([each.logit for each in some.best], some.mass)
                for some in (from_folder, from_shards)
            )
            error = max(error, float(np.abs(ours.objects - theirs.objects).max()), abs(ours.none - theirs.none))
    figures = {f"{name}_p50_s": float(np.median(one)) for name, one in times.items()}
    figures["shard_p99_s"] = float(np.percentile(times["slowest"], 99))
    agreement = {"same_top1": same / len(partials), "top1_no_worse": better / len(partials)}
    folder_s, shards_s = np.median(exhaustive_s, axis=0)
    return (
        figures
        | agreement
        | {"all_scored": reranked, "all_scored_top1": exhaustive_top1 / reranked, "all_scored_same": exact / reranked}
        | {"all_scored_error": error, "all_scored_folder_s": float(folder_s), "all_scored_shards_s": float(shards_s)}
    )


def measure(crowd: BlendedPhotos, photos: int, shards: int, touches: int, reranked: int, out: Path) -> dict[str, float]:
    """Measure everything at one number of photos. All photos are scored for `reranked` touches."""
    figures: dict[str, float] = {"photos": photos, "shards": shards} | write(crowd, photos, shards, out)
    stored = read_checkpoint_info(crowd.checkpoint.path)
    start = time.perf_counter()
    folder = folder_shard(IndexStore(out / "index").open(verify=False, threads=1), stored)
    figures["folder_open_s"] = time.perf_counter() - start
    manifest = read_sharded_manifest(out / "cluster")
    cluster = open_sharded_index(out / "cluster", manifest, stored, verify=False)
    figures |= compare(crowd, folder, cluster, touches, reranked)
    np.savez(out / "codes.npz", partials=crowd.touches, embeddings=crowd.embeddings(crowd.touches, "touch"))
    figures["folder_mb"] = _probe(MEMORY_PROBE, out / "index", out / "codes.npz")[0]
    figures["shard_mb"] = _probe(MEMORY_PROBE, out / "cluster" / manifest.shards[0].folder, out / "codes.npz")[0]
    return figures


def opened(places: dict[str, Path], model: Path) -> dict[str, float]:
    """Return the median CPU time in which a client opens each sharded index, in turn; {name of the figure: seconds}."""
    taken: dict[str, list[float]] = {name: [] for name in places}
    for _ in range(OPENINGS):
        for name, place in places.items():
            taken[name].append(_probe(OPEN_PROBE, place / "cluster", model)[0])
    return {f"client_open_{name}_s": float(np.median(one)) for name, one in taken.items()}


def _probe(program: str, *words: Any) -> list[float]:
    line = [sys.executable, "-c", program, *map(str, words)]
    done = subprocess.run(line, check=True, capture_output=True, text=True)
    return [float(word) for word in done.stdout.split()]


def on_ray(crowd: BlendedPhotos, photos: int, touches: int, out: Path) -> dict[str, float]:
    """Compare a sharded index of one shard on Ray with the folder, in turn: wall-clock seconds."""
    from retrieval.cluster.serving import Deployments, ReplicaSettings
    from retrieval.cluster.session import ray_session

    write(crowd, photos, 1, out)
    stored = read_checkpoint_info(crowd.checkpoint.path)
    manifest = read_sharded_manifest(out / "cluster")
    generation: Generation = open_shard(out / "cluster", manifest.shards[0], manifest.fingerprint, threads=1)
    folder: FolderShard = folder_shard(generation, stored)
    partials = crowd.touches[:touches]
    embeddings, posterior = crowd.embeddings(partials, "touch"), crowd.checkpoint.posterior
    times: dict[str, list[float]] = {"folder": [], "ray": []}
    with ray_session(2) as ray, threadpool_limits(1, "blas"):  # like the service: its threads spin between two queries
        remote = Deployments(ray, ReplicaSettings(cpus=0.5, wait_s=60.0)).open(out / "cluster", manifest, stored)
        arms = {"folder": folder, "ray": remote}
        for turn in range(-5, len(partials)):
            query = ShardQuery(embeddings[[turn]], partials[[turn]])
            for name, shard in arms.items():
                start = time.perf_counter()
                shard.search(query, 10, None, posterior)
                if turn >= 0:
                    times[name].append(time.perf_counter() - start)
    return {
        "ray_photos": photos,
        **{f"{name}_wall_p{at}_s": float(np.percentile(one, at)) for name, one in times.items() for at in (10, 50, 99)},
    }


def main() -> None:
    """Print the figures of each size as soon as they are available."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.shards", description=__doc__.split("\n\n")[0])
    parser.add_argument("--sizes", nargs="+", type=float, default=[1e4, 1e5, 1e6])
    parser.add_argument("--shards", type=int, default=8)
    parser.add_argument("--touches", type=int, default=TOUCHES)
    parser.add_argument("--reranked", type=int, default=3, help="touches for which all photos are scored")
    parser.add_argument("--model", type=Path, default=shipped_model())
    parser.add_argument("--ray", action="store_true", help="also measure Ray, with the first of the sizes")
    parser.add_argument("--json", action="store_true", help="one JSON document per line")
    arguments = parser.parse_args()
    crowd = drawn_photos(load_checkpoint(arguments.model).without_cells())
    with tempfile.TemporaryDirectory() as name:
        places = {f"{size:.0e}": Path(name) / str(int(size)) for size in arguments.sizes}
        for size, place in zip(arguments.sizes, places.values(), strict=True):
            options = arguments.shards, arguments.touches, arguments.reranked
            _show(measure(crowd, int(size), *options, place), arguments.json)
        _show(opened(places, arguments.model), arguments.json)
    if arguments.ray:
        with tempfile.TemporaryDirectory() as name:
            _show(on_ray(crowd, int(arguments.sizes[0]), arguments.touches, Path(name)), arguments.json)


def _show(figures: dict[str, float], as_json: bool) -> None:
    print(json.dumps(figures) if as_json else "  ".join(f"{name} {value:.4g}" for name, value in figures.items()))
    sys.stdout.flush()


if __name__ == "__main__":
    main()
