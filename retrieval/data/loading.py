"""The loader: worker threads decode images ahead of the caller.

It uses threads, not processes: decoding and resizing a picture release the GIL, and a thread's images need no copy from
another process.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")
Result = TypeVar("Result")


def worker_count(workers: int | str = "auto") -> int:
    """Return the number of workers that decode images: `workers`, or for "auto" one for each core of this rank."""
    if isinstance(workers, int):
        return workers
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def worker_pool(workers: int | str = "auto") -> ThreadPoolExecutor:
    """Return a pool of threads that decode images; `workers` as in `worker_count`."""
    return ThreadPoolExecutor(worker_count(workers), thread_name_prefix="decode")


def prefetch(futures: Iterable[Future[Result]], depth: int) -> Iterator[Result]:
    """Yield the results in order, while up to `depth` later ones are prepared.

    Args:
        futures: Iterable that starts the work of each future when it yields it.
        depth: At least 1.
    """
    waiting: deque[Future[Result]] = deque()
    for future in futures:
        waiting.append(future)
        if len(waiting) > depth:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def map_in_order(pool: Executor, load: Callable[[T], Result], items: Iterable[T], depth: int = 16) -> Iterator[Result]:
    """Yield `load(item)` of each item in order, computed by `pool` up to `depth` items ahead."""
    return prefetch((pool.submit(load, item) for item in items), depth)


class TimedFunction:
    """A function that records the duration of each call in seconds; several threads may call it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self.seconds: list[float] = []

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        start = time.perf_counter()
        result = self._function(*arguments)
        self.seconds.append(time.perf_counter() - start)
        return result
