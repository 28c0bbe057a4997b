"""Work on objects in this process or in several worker processes, each with its own rig."""

import functools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import Any, Generic, Self, TypeVar

import cv2

from robot.errors import RobotError

T = TypeVar("T")
Work = Callable[[str, int], T]
"""A function of object id and attempt number."""

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_DIED = (
    "a worker process died: it was killed, or memory ran out. The recorded grasps are complete; run the command again "
    "to continue, with fewer jobs if memory is short"
)


class WorkerPool(Generic[T]):
    """Runs work in this process with one job, else in spawned worker processes.

    Workers are spawned, not forked: a forked copy of a process with OpenCV or BLAS threads may hang. OpenCV is limited
    to one thread while the pool is open, with one job too. Some of its filters give other last digits in several
    threads, and a recording must not depend on the number of jobs.

    Args:
        jobs: Number of processes; 1 runs `local_work` when its result is requested.
        local_work: The work for one job.
        make: Returns the work; called once in each worker process, so it must be picklable.

    Attributes:
        window: Recommended number of pieces of work in progress at a time.
    """

    def __init__(self, jobs: int, local_work: Work[T], make: Callable[[], Work[T]]) -> None:
        self._local_work, self._pool = local_work, None
        self.window = 1 if jobs == 1 else 4 * jobs
        if jobs > 1:
            self._pool = ProcessPoolExecutor(
                jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_start_worker, initargs=(make,)
            )

    def submit(self, object_id: str, number: int) -> Callable[[], T]:
        """Start an attempt at an object; return a callable that waits for its result.

        Both raise RobotError if a worker process died; the callable does so for any failure in a worker.
        """
        if self._pool is None:
            return functools.partial(self._local_work, object_id, number)
        try:
            return functools.partial(_result, self._pool.submit(_run_work, object_id, number), object_id, number)
        except BrokenProcessPool as error:
            raise RobotError(_DIED) from error

    def __enter__(self) -> Self:
        self._cv2_threads, self._environment = cv2.getNumThreads(), {name: os.environ.get(name) for name in _THREADS}
        cv2.setNumThreads(1)
        os.environ.update(dict.fromkeys(_THREADS, "1"))  # inherited by the workers
        return self

    def __exit__(self, *_: object) -> None:
        """Wait for the work in progress and cancel the rest."""
        cv2.setNumThreads(self._cv2_threads)
        for name in _THREADS:
            del os.environ[name]
        os.environ.update({name: value for name, value in self._environment.items() if value is not None})
        if self._pool is None:
            return
        # A second Ctrl-C would interrupt the join, and Python would then hang at exit (CPython issue 90882).
        is_main = threading.current_thread() is threading.main_thread()
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main else None
        self._pool.shutdown(cancel_futures=True)
        if is_main:
            signal.signal(signal.SIGINT, handler)


def _result(future: Future[T], object_id: str, number: int) -> T:
    try:
        return future.result()
    except RobotError:
        raise
    except BrokenProcessPool as error:
        raise RobotError(_DIED) from error
    except Exception as error:
        raise RobotError(
            f"attempt {number} at {object_id} failed in a worker process: {type(error).__name__}: {error}"
        ) from error


# In the worker ----------------------------------------------------------------------------------------------

_make_work: Callable[[], Work[Any]]


def _start_worker(make: Callable[[], Work[Any]]) -> None:
    """Initialise a worker; must not fail, because the pool hides the reason. Ctrl-C is left to the parent."""
    global _make_work
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    _make_work = functools.cache(make)


def _exit_with_parent() -> None:
    """Exit when the parent dies; a killed parent cannot stop its workers, which would wait for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _run_work(object_id: str, number: int) -> Any:
    return _make_work()(object_id, number)
