"""Run times, and the machine on which they are measured."""

import dataclasses
import os
import platform
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median
from timeit import timeit

from retrieval.frontier.points import Tradeoff
from retrieval.model.encode import one_thread

MIN_SECONDS = 0.005


def time_points(
    points: Sequence[Tradeoff], works: Sequence[Callable[[], object]], repeats: int
) -> tuple[Tradeoff, ...]:
    """Return the points, each with the median seconds of its work over `repeats` rounds, on one thread.

    The works take turns, so that a busy moment slows all of them. Each runs once for warm-up. Short works are timed
    over several runs together.
    """
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped, unused-ignore]

    with one_thread(), threadpool_limits(1):  # PyTorch and numpy
        calls = [max(1, int(MIN_SECONDS / max(timeit(work, number=1), 1e-9))) for work in works]
        rounds = [
            [timeit(work, number=count) / count for work, count in zip(works, calls, strict=True)]
            for _ in range(repeats)
        ]
    return tuple(
        dataclasses.replace(point, seconds=median(taken))
        for point, taken in zip(points, zip(*rounds, strict=True), strict=True)
    )


def machine() -> dict[str, str | int | None]:
    """Return processor, cores and system, because times depend on the machine."""
    processor = platform.processor() or platform.machine()
    with suppress(OSError):  # platform.processor() is often empty
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
        processor = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), processor)
    return {"processor": processor, "cores": os.cpu_count(), "system": platform.system()}
