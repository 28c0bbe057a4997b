"""`python -m benchmarks.scale [--sizes 1e3 1e4 1e5] [--recording R --features F]`: time against N.

Catalogues of N photos are drawn from the trained model's own distribution: partial activations of recorded photos, each
a blend of two (w A + (1 - w) B, w uniform in 1/2..1), with their embeddings by the checkpoint's candidate encoder. The
exhaustive top-1 of a touch is the photo with the greatest match logit. One half of the stored touches of the checkpoint
(of its validation objects) chooses the settings and the number of candidates that contain the exhaustive top-1 for 99 %
of them. `MARGIN` times this number is used, because a hundred touches hardly determine the last percent. The reported
recall is that of other touches: the other half, and those of the recording.

The cost model, for h = hidden, d = embedding_dim, k candidates, L = 4 sqrt(N) lists and p visited lists:

    stage        flops                  bytes read                    grows as
    exhaustive   2 h^2 N                2 h N (float16 partials)      N
    flat         2 d N                  4 d N                         N
    ivf          2 d (L + p N / L)      4 d L + code p N / L          N^1/2 (p fixed), code = d (sq8), d / 8 (pq)
    hnsw         2 d ef log N           4 d ef log N                  log N
    rescoring    2 d k                  4 d k, in random places       k
    rerank       2 h^2 k                2 h k, in random places       k
    build        rows: constant each; lists: 2 d L 64 L training for each of 10 rounds + 2 d L N     N, N^3/2

So with k = c N candidates, and search by lists, exhaustive search takes at most 1 / c times as long.

Run it on one thread (OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1), like a single query: threads that wait for each other
make small products many times slower. A million photos take 1.2 GB on disk, and 20 minutes.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from indexes import load_kind
from indexes.errors import ParameterError
from indexes.kinds.faiss_index import FLAT, FaissIndex
from indexes.kinds.vector_index import VectorIndex
from indexes.store.folder import IndexStore
from indexes.store.generation import Arrays, Generation
from indexes.store.manifest import FileChecksum
from indexes.store.rows import Row
from retrieval.commands.main import main as retrieve
from retrieval.console.progress import show_progress
from retrieval.data.dataset import load_grasps
from retrieval.frontier.candidates import STRUCTURES
from retrieval.frontier.points import format_duration
from retrieval.metrics.intervals import binomial_interval
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.fusion_scorer import FusionScorer
from retrieval.model.shipped import shipped_model
from retrieval.training.features import encode_recording

KINDS = {"flat": (), **STRUCTURES}
"""Kinds, and the search setting of each with its values."""
BLOCK = 8192
MAX_CANDIDATES = 16_000
TARGET, MARGIN = 0.99, 4
TIMED = 40
QUERIES, HELD_OUT = 200, 1000
"""Touches that choose the number of candidates, and others that evaluate it."""
RERANKED = 3e13
"""Maximum flops for exhaustive scoring. Larger catalogues use fewer touches, but at least 60."""

PROBE = """
import sys, time
from indexes.store.folder import IndexStore
import numpy as np
def anonymous():
    return int(next(line for line in open("/proc/self/status") if line.startswith("RssAnon")).split()[1])
import faiss
before, start = anonymous(), time.perf_counter()
found = IndexStore(sys.argv[1]).open(verify=False)
opened = time.perf_counter() - start
query = np.ascontiguousarray(found.embeddings[:1])
found.index.search(query, 1000)
print(opened, (anonymous() - before) / 1024)
"""


@dataclass
class Size:
    """All measurements at one number of photos: seconds, bytes and counts by name."""

    photos: int
    queries: int = 0
    held_out: int = 0
    figures: dict[str, float] = field(default_factory=dict)
    kinds: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class BlendedPhotos:
    """A model with the material of synthetic catalogues and queries.

    Attributes:
        checkpoint: the model.
        scorer: its fusion head.
        photos: (n, h) partial activations of recorded photos, from which catalogues are blended.
        touches: (Q, h) partial activations of touches that choose the number of candidates.
        held_out: (J, h) partial activations of other touches.
    """

    checkpoint: Checkpoint
    scorer: FusionScorer
    photos: np.ndarray
    touches: np.ndarray
    held_out: np.ndarray

    @torch.inference_mode()
    def embeddings(self, partials: np.ndarray, modality: str) -> np.ndarray:
        """Return unit embeddings (n, d) of "touch" or "photo" partial activations."""
        return getattr(self.checkpoint.matcher.candidate_encoder, modality)(torch.from_numpy(partials)).numpy()

    def blocks(self, start: int, stop: int, seed: int) -> Iterator[Arrays]:
        """Yield arrays of photos `start` to `stop` - 1 of a catalogue, block by block."""
        rng = np.random.default_rng([seed, start])
        for first in range(start, stop, BLOCK):
            count = min(BLOCK, stop - first)
            one, other = rng.integers(len(self.photos), size=(2, count))
            weight = rng.uniform(0.5, 1, size=(count, 1)).astype(np.float32)
            partials = weight * self.photos[one] + (1 - weight) * self.photos[other]
            yield {"embeddings": self.embeddings(partials, "photo"), "partials": partials.astype(np.float16)}


def blended_photos(model: Path, recording: Path, features: Path | None) -> BlendedPhotos:
    """Return the blended photos of a recording; `features` caches the encoding."""
    checkpoint = load_checkpoint(model).without_cells()  # blended photos have no cells
    if checkpoint.queries is None or checkpoint.matcher.candidate_encoder is None:
        raise SystemExit(f"{model} has no stored touches or no candidate encoder; train it again")
    found = encode_recording(load_grasps(recording), checkpoint.matcher, checkpoint.config, features)
    with torch.inference_mode():
        photos = checkpoint.matcher.photo_encoding(torch.from_numpy(found.photo)).partial.numpy()
        touches = checkpoint.matcher.touch_encoding(torch.from_numpy(found.touch).flatten(1)).partial.numpy()
    rng, queries = np.random.default_rng(0), checkpoint.queries.astype(np.float32)
    middle = len(queries) // 2
    held_out = rng.permutation(np.concatenate([queries[middle:], touches]))
    scorer = checkpoint.matcher.head.scorer
    return BlendedPhotos(checkpoint, scorer, np.unique(photos, axis=0), queries[:middle], held_out)


def measure(crowd: BlendedPhotos, photos: int, kinds: Sequence[str], folder: Path) -> Size:
    """Build, search and grow an index of this many photos of each kind in `folder`."""
    max_touches = max(60, int(RERANKED / (2 * crowd.photos.shape[1] ** 2 * photos)))
    chosen = min(QUERIES, len(crowd.touches), max_touches // 3)
    evaluated = min(HELD_OUT, len(crowd.held_out), max_touches - chosen)
    size, store = Size(photos, chosen, evaluated), IndexStore(folder)
    generation = _build(crowd, store, size)
    partials = generation.arrays["partials"]
    touches = np.concatenate([crowd.touches[:chosen], crowd.held_out[:evaluated]])
    exhaustive_top1, size.figures["exhaustive_s"] = _top1(crowd.scorer, touches, partials)
    for kind in kinds:
        name = kind.format(lists=1 << max(0, round(np.log2(np.sqrt(photos)))))
        try:
            load_kind(name).require(name, photos, generation.manifest.dim)
        except ParameterError as error:  # too few vectors
            size.kinds[kind] = {"refused": str(error)}
            continue
        start = time.perf_counter()
        FaissIndex.build(generation.embeddings, name)
        figures = {"structure_s": time.perf_counter() - start}
        indexed = write_blocks(store, photos, blocks_of(generation), name)
        figures |= opened(folder) | on_disk(indexed)
        size.kinds[kind] = figures | _operating_point(crowd, indexed, touches, exhaustive_top1, chosen)
        point = size.kinds[kind]
        point["gain"] = size.figures["exhaustive_s"] / (point["search_s"] + point["rerank_s"])
    return size


def blocks_of(generation: Generation) -> Iterator[Arrays]:
    """Yield the arrays of a generation in blocks, for a new one."""
    arrays = {"embeddings": generation.embeddings, **generation.arrays}
    for start in range(0, generation.count, BLOCK):
        yield {name: array[start : start + BLOCK] for name, array in arrays.items()}


def write_blocks(store: IndexStore, photos: int, blocks: Iterable[Arrays], kind: str = FLAT) -> Generation:
    """Write a generation of blocks of arrays, and return it opened."""
    store.write(rows_of(photos), blocks, kind=kind)
    return store.open(verify=False)


def rows_of(photos: int) -> list[Row]:
    """Return rows of this many photos, three of each object."""
    names = [(f"o{number // 3:07d}", f"{number % 3}.jpg") for number in range(photos)]
    return [Row(f"{name}/{photo}", name, f"{number:064x}") for number, (name, photo) in enumerate(names)]


def _build(crowd: BlendedPhotos, store: IndexStore, size: Size) -> Generation:
    """Stream the catalogue to disk; the time for drawing it is not measured."""
    drawing_s, peak_mb, before = 0.0, 0.0, anonymous_mb()

    def blocks() -> Iterator[Arrays]:
        nonlocal drawing_s, peak_mb
        source = crowd.blocks(0, size.photos, 0)
        while True:
            begun = time.perf_counter()
            block = next(source, None)
            drawing_s += time.perf_counter() - begun
            if block is None:
                return
            yield block
            peak_mb = max(peak_mb, anonymous_mb() - before)

    start = time.perf_counter()
    generation = write_blocks(store, size.photos, blocks())
    size.figures |= {"build_s": time.perf_counter() - start - drawing_s, "build_mb": peak_mb}
    return generation


def _top1(scorer: FusionScorer, touches: np.ndarray, partials: Any) -> tuple[np.ndarray, float]:
    """Return the exhaustive top-1 of each touch, and the median seconds for scoring all photos."""
    exhaustive_top1, seconds = [], []
    for touch in touches:
        start = time.perf_counter()
        exhaustive_top1.append(int(scorer.logits(touch[None], partials).argmax()))
        seconds.append(time.perf_counter() - start)
    return np.array(exhaustive_top1), float(np.median(seconds))


def _operating_point(
    crowd: BlendedPhotos, made: Generation, touches: np.ndarray, exhaustive_top1: np.ndarray, choosing: int
) -> dict[str, Any]:
    """Return the fastest setting whose candidates contain the target fraction of exhaustive top-1s.

    If no setting reaches it, return the most complete one. The first `choosing` touches choose, the others evaluate.
    """
    queries, partials, points = crowd.embeddings(touches, "touch"), made.arrays["partials"], []
    timed, built = range(min(TIMED, len(touches))), made.index
    needed = _needed(made, queries, exhaustive_top1)
    for index in _variants(built):
        made.index = index
        k = _candidates(made, queries[:choosing], exhaustive_top1[:choosing])
        contained = np.array(
            [
                top1 in made.index.search(query[None], k)[1][0]
                for query, top1 in zip(queries, exhaustive_top1, strict=True)
            ]
        )
        evaluated = contained[choosing:]
        search = _median(lambda n, k=k: made.index.search(queries[n : n + 1], k), timed)
        found = [made.index.candidates(queries[n : n + 1], k)[0] for n in timed]
        rerank = _median(lambda n, found=found: crowd.scorer.logits(touches[n : n + 1], partials, found[n]), timed)
        low, high = binomial_interval(int(evaluated.sum()), len(evaluated))
        point = {"k": k, "recall": float(evaluated.mean()), "low": low, "high": high}
        point |= {"search_s": search, "rerank_s": rerank, "kind": index.kind}
        points.append((float(contained[:choosing].mean()), point))
    made.index = built
    for _, point in points:
        point["needed"] = needed
    good = [point for chosen, point in points if chosen >= TARGET]
    if good:
        return min(good, key=lambda point: point["search_s"] + point["rerank_s"])
    return max(points, key=lambda each: each[0])[1]


def _variants(index: VectorIndex) -> Iterator[VectorIndex]:
    """Yield the index with each of its search settings."""
    if index.kind == FLAT or not isinstance(index, FaissIndex):
        yield index
        return
    family = index.kind[:3] + index.kind[-3:]
    setting, values = next(one for pattern, one in STRUCTURES.items() if pattern[:3] + pattern[-3:] == family)
    for value in values:
        yield index.with_settings(f"{setting}={value}")


def _candidates(made: Generation, queries: np.ndarray, exhaustive_top1: np.ndarray) -> int:
    """Return `MARGIN` times the number of candidates that these touches need."""
    return min(MARGIN * _needed(made, queries, exhaustive_top1), MAX_CANDIDATES, made.count)


def _needed(made: Generation, queries: np.ndarray, exhaustive_top1: np.ndarray) -> int:
    """Return the least number of candidates that contain the target fraction of exhaustive top-1s, up to a limit."""
    limit = min(MAX_CANDIDATES, made.count)
    found = (made.index.search(query[None], limit)[1][0] for query in queries)
    places = [np.flatnonzero(rows == top1) for rows, top1 in zip(found, exhaustive_top1, strict=True)]
    needed = np.sort([int(place[0]) + 1 if len(place) else limit for place in places])
    return int(needed[int(np.ceil(TARGET * len(needed))) - 1])


def opened(folder: Path) -> dict[str, float]:
    """Return the seconds for opening the index in a separate process, and its memory without mapped files."""
    done = subprocess.run([sys.executable, "-c", PROBE, str(folder)], check=True, capture_output=True, text=True)
    seconds, memory = map(float, done.stdout.split())
    return {"open_s": seconds, "memory_mb": memory}


def on_disk(made: Generation) -> dict[str, float]:
    structure = made.manifest.files.get("vectors.faiss", FileChecksum(0, "")).bytes
    return {
        "disk_mb": sum(seal.bytes for seal in made.manifest.files.values()) / 2**20,
        "structure_mb": structure / 2**20,
    }


def anonymous_mb() -> float:
    with Path("/proc/self/status").open() as lines:
        return int(next(line for line in lines if line.startswith("RssAnon")).split()[1]) / 1024


def _median(work: Callable[[int], object], numbers: Sequence[int]) -> float:
    seconds = []
    for number in numbers:
        start = time.perf_counter()
        work(number)
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def lines(size: Size) -> Iterator[str]:
    """Yield the measurements at one size as text."""
    f = size.figures
    written, scored = format_duration(f["build_s"]), format_duration(f["exhaustive_s"])
    yield (
        f"{size.photos:,} photos: written in {written} with {f['build_mb']:.0f} MB of memory; scoring all of them "
        f"takes {scored} ({size.queries} touches choose, {size.held_out} evaluate)"
    )
    for kind, p in size.kinds.items():
        if "refused" in p:
            yield f"  {kind}: {p['refused']}"
            continue
        times = {name: format_duration(value) for name, value in p.items() if name.endswith("_s")}
        yield (
            f"  {p['kind']}: {p['gain']:.3g} times faster than scoring all, exhaustive top-1 found "
            f"{p['recall']:.1%} ({p['low']:.1%} to {p['high']:.1%}) among {p['k']} ({p['needed']} for 99 % of all); "
            f"search {times['search_s']}, rerank {times['rerank_s']}; structure built in {times['structure_s']}, "
            f"{p['structure_mb']:.0f} of {p['disk_mb']:.0f} MB on disk, {p['memory_mb']:.0f} MB in memory, "
            f"opened in {times['open_s']}"
        )


def collected(folder: Path) -> Path:
    """Collect a small recording on the simulated rig."""
    words = ["collect", "--rig", "sim", "--objects", "60", "--grasps", "2", "--seed", "20000", "--jobs", "2"]
    if retrieve([*words, "--out", str(folder / "recording")]):
        raise SystemExit("the recording could not be collected")
    return folder / "recording"


def main() -> None:
    """Print each size as soon as it is measured."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__.split("\n\n")[0])
    parser.add_argument("--sizes", nargs="+", type=float, default=[1e3, 1e4, 1e5])
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--model", type=Path, default=shipped_model())
    parser.add_argument(
        "--recording", type=Path, help="recording whose photos are blended (default: a small one is collected)"
    )
    parser.add_argument("--features", type=Path, help="file to store encoded features")
    arguments = parser.parse_args()
    show_progress()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        crowd = blended_photos(arguments.model, arguments.recording or collected(folder), arguments.features)
        for number in arguments.sizes:
            size = measure(crowd, int(number), arguments.kinds, folder / "index")
            shutil.rmtree(folder / "index")
            print("\n".join(lines(size)), flush=True)


if __name__ == "__main__":
    main()
