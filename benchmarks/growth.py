"""`python -m benchmarks.growth [--grasps 1 2 4 8] [--objects 5 10 20 40] [--touches 1 2 5 10 20] [--json]`.

Growth of CPU time with accepted grasps per object and with objects that the simulated rig collects, in this process
with planning, gate and files, and with grasps per query of the shipped model. Everything runs on one thread. Every
round measures all sizes in turn; the median of the rounds is reported. Slopes are those of log time over log number.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import duration
from benchmarks.query import encoders, gel_images, searcher_of, write_index
from benchmarks.simulation import collected
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.defaults import shipped_model

PHOTOS, OBJECTS, GRASPS = 1_000, 10, 2
"""Photos of the index that is queried; objects while grasps grow, and grasps while objects grow."""


def collecting(grasps: Sequence[int], objects: Sequence[int], rounds: int) -> Iterator[tuple[str, dict[int, float]]]:
    """Yield seconds by accepted grasps per object, and by objects."""
    cv2.setNumThreads(1)
    collected(max(objects[:1] + grasps[:1]), 1)  # compiles, and fills the caches
    yield "grasps per object", _timed(lambda number: collected(OBJECTS, number), grasps, rounds)
    yield "objects", _timed(lambda number: collected(number, GRASPS), objects, rounds)


def querying(touches: Sequence[int], rounds: int, photos: int = PHOTOS) -> Iterator[tuple[str, dict[int, float]]]:
    """Yield seconds by grasps per query on an index of synthetic photos, with the fastest installed encoder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        checkpoint = load_checkpoint(Path(shutil.copy(shipped_model(), folder / "model.safetensors")))
        write_index(folder / "index", checkpoint, photos)
        *_, encoder = encoders(folder, checkpoint)
        touch = gel_images(folder, checkpoint.config.matcher.fingers)
        searcher = searcher_of(folder / "index", checkpoint, encoder)
        searcher.query([touch])
        yield "grasps per query", _timed(lambda number: searcher.query([touch] * number), touches, rounds)


def _timed(work: Callable[[int], object], numbers: Sequence[int], rounds: int) -> dict[int, float]:
    seconds: dict[int, list[float]] = {number: [] for number in numbers}
    for _ in range(rounds):
        for number in numbers:
            start = time.process_time()
            work(number)
            seconds[number].append(time.process_time() - start)
    return {number: float(np.median(each)) for number, each in seconds.items()}


def slope(seconds: dict[int, float]) -> float:
    """Return d log t / d log N, fitted over all sizes."""
    return float(np.polyfit(np.log(list(seconds)), np.log(list(seconds.values())), 1)[0])


def main() -> None:
    """Print a line for each of the three."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.growth", description=__doc__.split("\n\n")[1])
    parser.add_argument("--grasps", nargs="+", type=int, default=[1, 2, 4, 8])
    parser.add_argument("--objects", nargs="+", type=int, default=[5, 10, 20, 40])
    parser.add_argument("--touches", nargs="+", type=int, default=[1, 2, 5, 10, 20])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true", help="one JSON document per line")
    arguments = parser.parse_args()
    tables = [collecting(arguments.grasps, arguments.objects, arguments.rounds)]
    tables.append(querying(arguments.touches, arguments.rounds))
    for what, seconds in (line for table in tables for line in table):
        power = slope(seconds)
        shown = ", ".join(f"{number}: {duration(each)}" for number, each in seconds.items())
        line = {"what": what, "seconds": seconds, "slope": power}
        print(json.dumps(line) if arguments.json else f"N^{power:.2f}  {what}: {shown}", flush=True)


if __name__ == "__main__":
    main()
