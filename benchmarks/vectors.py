"""`python -m benchmarks.vectors [--photos 1e7] [--kinds flat ivf_sq8] [--recording R]`: a large index, not reranked.

Build, memory, opening and candidates of an index that contains only rows and embeddings, no partial activations: the
cost of `indexes` without the matcher, while `benchmarks.scale` also measures the reranking of its candidates. Photos
are drawn as in `benchmarks.scale`, and the 64 numbers are those of the checkpoint's candidate encoder. Each touch
requests `--candidates`; for each setting of a kind's ladder the recall of the exact best is printed. CPU time is
printed next to wall-clock time, because other programs may run. Memory is that of the process without mapped files. Ten
million photos take 11 GB on disk and 25 minutes.
"""

import argparse
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.common import duration
from benchmarks.scale import BlendedPhotos, anonymous_mb, blended_photos, collected, on_disk, opened, rows_of
from indexes.store.folder import IndexStore
from indexes.store.generation import Generation
from indexes.store.tables import Block
from retrieval.search.defaults import shipped_model

QUERIES = 40


@contextmanager
def timed(label: str) -> Iterator[None]:
    """Print the seconds of a part, and the peak growth of this process's memory without mapped files."""
    before, peak_mb, done = anonymous_mb(), 0.0, threading.Event()

    def watch() -> None:
        nonlocal peak_mb
        while not done.wait(0.1):
            peak_mb = max(peak_mb, anonymous_mb() - before)

    thread = threading.Thread(target=watch)
    thread.start()
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        yield
    finally:
        done.set()
        thread.join()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{label}: {duration(wall)}, CPU {duration(cpu)}, at most {peak_mb:,.0f} MB of memory", flush=True)


def bare(crowd: BlendedPhotos, photos: int) -> Iterator[Block]:
    """Return the crowd's photos without their partial activations."""
    return (Block(block.rows, block.embeddings) for block in crowd.blocks(0, photos, 0))


def print_candidates(made: Generation, queries: np.ndarray, k: int, exact: list[np.ndarray]) -> None:
    """Print the time of candidates and their recall, along the ladder of the kind."""
    built = made.index
    for index in built.search_variants():
        made.index = index
        found, seconds = [], []
        for query in queries:
            start = time.thread_time()
            found.append(made.candidates(query[None], k)[0])
            seconds.append(time.thread_time() - start)
        recalls = [len(np.intersect1d(one, other)) / k for one, other in zip(found, exact, strict=True)]
        spread = ", ".join(duration(float(value)) for value in np.percentile(seconds, [50, 5, 95]))
        print(
            f"  {index.settings()}: {spread} (median, 5 and 95 % of queries; CPU), {np.mean(recalls):.4f} of the exact"
        )
    made.index = built


def main() -> None:
    """Print each part as soon as it is measured."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.vectors", description=__doc__.split("\n\n")[0])
    parser.add_argument("--photos", type=float, default=1e7)
    parser.add_argument("--kinds", nargs="+", default=["flat", "ivf_sq8"])
    parser.add_argument("--candidates", type=int, default=1000)
    parser.add_argument(
        "--recording", type=Path, help="recording whose photos are blended (default: a small one is collected)"
    )
    parser.add_argument("--features", type=Path, help="file to store encoded features")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder, count = Path(made), int(arguments.photos)
        crowd = blended_photos(shipped_model(), arguments.recording or collected(folder), arguments.features)
        store = IndexStore(folder / "index")
        with timed(f"{count:,} photos drawn and written"):
            generation = store.write_blocks(bare(crowd, count), fingerprint={}, kind="flat", self_check=64)
        queries = crowd.embeddings(crowd.touches[:QUERIES], "touch")
        exact = [generation.candidates(query[None], arguments.candidates)[0] for query in queries]
        for kind in arguments.kinds:
            if kind != generation.manifest.kind:
                with timed(f"{kind}, written again with its structure"):
                    generation = store.write_blocks(
                        rows_of(generation),
                        fingerprint={},
                        kind=kind,
                        threads=1,
                        parent=generation,
                        self_check=64,
                        keep=0,
                    )
            figures = opened(folder / "index") | on_disk(generation)
            print(
                f"{kind}: {figures['disk_mb']:,.0f} MB on disk ({figures['structure_mb']:,.0f} of it the structure), "
                f"opened in {duration(figures['open_s'])}, {figures['memory_mb']:,.0f} MB in memory after a query",
                flush=True,
            )
            print_candidates(generation, queries, arguments.candidates, exact)
        shutil.rmtree(folder / "index")


if __name__ == "__main__":
    main()
