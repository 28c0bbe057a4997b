"""`python -m benchmarks.vectors [--photos 1e7] [--kinds flat ivf_sq8] [--recording R]`: a large index by itself.

Build, memory, opening and candidates of an index that holds rows and embeddings alone, no halves: what `indexes` takes
by itself, where `benchmarks.scale` measures it beside the judging of what it names. Photos are drawn as there,
and the 64 numbers are those of the checkpoint's candidate_encoder. Touches ask for `--candidates`; the share of them that is among
the exact best is told for each setting of a kind's ladder. CPU time is told beside the clock's, as other programs may
run; memory is what the process holds beside mapped files. Ten million photos take 11 GB on the disk and 25 minutes.
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

ASKED = 40


@contextmanager
def timed(what: str) -> Iterator[None]:
    """Print seconds of a part, and the most that this process held meanwhile beside mapped files, above what it held
    before."""
    before, most, done = anonymous_mb(), 0.0, threading.Event()

    def look() -> None:
        nonlocal most
        while not done.wait(0.1):
            most = max(most, anonymous_mb() - before)

    thread = threading.Thread(target=look)
    thread.start()
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        yield
    finally:
        done.set()
        thread.join()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{what}: {duration(wall)}, CPU {duration(cpu)}, at most {most:,.0f} MB of memory", flush=True)


def bare(crowd: BlendedPhotos, photos: int) -> Iterator[Block]:
    """The crowd's photos without their halves."""
    return (Block(block.rows, block.embeddings) for block in crowd.blocks(0, photos, 0))


def ask(made: Generation, queries: np.ndarray, k: int, exact: list[np.ndarray]) -> None:
    """Print what candidates take, and how many of the exact ones are among them, along the ladder of the kind."""
    built = made.index
    for index in built.search_variants():
        made.index = index
        found, seconds = [], []
        for query in queries:
            start = time.thread_time()
            found.append(made.candidates(query[None], k)[0])
            seconds.append(time.thread_time() - start)
        shares = [len(np.intersect1d(one, other)) / k for one, other in zip(found, exact, strict=True)]
        spread = ", ".join(duration(float(value)) for value in np.percentile(seconds, [50, 5, 95]))
        print(
            f"  {index.settings()}: {spread} (median, 5 and 95 % of queries; CPU), {np.mean(shares):.4f} of the exact"
        )
    made.index = built


def main() -> None:
    """Print every part as soon as it is measured."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.vectors", description=__doc__.split("\n\n")[0])
    parser.add_argument("--photos", type=float, default=1e7)
    parser.add_argument("--kinds", nargs="+", default=["flat", "ivf_sq8"])
    parser.add_argument("--candidates", type=int, default=1000)
    parser.add_argument("--recording", type=Path, help="whose photos are blended; a small one is collected where None")
    parser.add_argument("--features", type=Path, help="where encoded features are kept")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder, count = Path(made), int(asked.photos)
        crowd = blended_photos(shipped_model(), asked.recording or collected(folder), asked.features)
        store = IndexStore(folder / "index")
        with timed(f"{count:,} photos drawn and written"):
            generation = store.write_blocks(bare(crowd, count), fingerprint={}, kind="flat", self_check=64)
        queries = crowd.embeddings(crowd.touches[:ASKED], "touch")
        exact = [generation.candidates(query[None], asked.candidates)[0] for query in queries]
        for kind in asked.kinds:
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
                f"{kind}: {figures['disk_mb']:,.0f} MB on the disk ({figures['structure_mb']:,.0f} its structure), "
                f"opened in {duration(figures['open_s'])}, {figures['memory_mb']:,.0f} MB in memory once asked",
                flush=True,
            )
            ask(generation, queries, asked.candidates, exact)
        shutil.rmtree(folder / "index")


if __name__ == "__main__":
    main()
