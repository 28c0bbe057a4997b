"""How long work takes, and on which machine."""

import dataclasses
import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median

from retrieval.frontier.points import Tradeoff
from retrieval.model.encode import one_thread

MIN_SECONDS = 0.005


def time_points(
    points: Sequence[Tradeoff], works: Sequence[Callable[[], object]], repeats: int
) -> tuple[Tradeoff, ...]:
    """The points, each with the median seconds of its work: all take turns, so that a busy moment slows all of them.

    Every work is run once before, which is not counted; short work is timed several runs together. All on one thread.
    """
    with _one_thread():
        calls = [max(1, int(MIN_SECONDS / max(_seconds(work, 1), 1e-9))) for work in works]
        rounds = [[_seconds(work, count) for work, count in zip(works, calls, strict=True)] for _ in range(repeats)]
    return tuple(
        dataclasses.replace(point, seconds=median(taken))
        for point, taken in zip(points, zip(*rounds, strict=True), strict=True)
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """PyTorch; and numpy, by threadpoolctl, which scikit-learn brings along."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped, unused-ignore]

    with one_thread(), threadpool_limits(1):
        yield


def _seconds(work: Callable[[], object], calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        work()
    return (time.perf_counter() - start) / calls


def machine() -> dict[str, str | int | None]:
    """Processor and cores: times of another machine are other times."""
    return {"processor": _processor(), "cores": os.cpu_count(), "system": platform.system()}


def _processor() -> str:
    """The name in /proc/cpuinfo where there is one: platform.processor() is often empty."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        lines = []
    named = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())
