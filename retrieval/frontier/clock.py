"""Run times, and the machine on which they are measured."""

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
    """Return the points, each with the median seconds of its work.

    All works are run alternately, so that a busy moment slows all of them. Each runs once for warm-up. Short works are
    timed over several runs together. Everything runs on one thread.

    Args:
        points: The points.
        works: The work of each point.
        repeats: Number of timed rounds.
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
    """Limit PyTorch and numpy to one thread; threadpoolctl comes with scikit-learn."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped, unused-ignore]

    with one_thread(), threadpool_limits(1):
        yield


def _seconds(work: Callable[[], object], calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        work()
    return (time.perf_counter() - start) / calls


def machine() -> dict[str, str | int | None]:
    """Return processor, cores and system, because times depend on the machine."""
    return {"processor": _processor(), "cores": os.cpu_count(), "system": platform.system()}


def _processor() -> str:
    """Return the name in /proc/cpuinfo if there is one: platform.processor() is often empty."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        lines = []
    named = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())
