"""Threads that decode images ahead of the caller: decoding and resizing a picture release the GIL."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
Result = TypeVar("Result")


def worker_count() -> int:
    """Return the number of cores of this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_pool() -> ThreadPoolExecutor:
    """Return a pool of threads that decode images, one for each core."""
    return ThreadPoolExecutor(worker_count(), thread_name_prefix="decode")


def map_in_order(pool: Executor, load: Callable[[T], Result], items: Iterable[T], depth: int = 16) -> Iterator[Result]:
    """Yield `load(item)` of each item in order, computed by `pool` up to `depth` items ahead."""
    waiting: deque[Future[Result]] = deque()
    for item in items:
        waiting.append(pool.submit(load, item))
        if len(waiting) > depth:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
