"""Work on objects, by this process or by several at once, each with a rig of its own."""

import functools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any, Generic, Self, TypeVar

import cv2

from robot.errors import RobotError

T = TypeVar("T")
Work = Callable[[str, int], T]
"""What is done with an object, by its id, for the time of this number."""

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class WorkerPool(Generic[T]):
    """Does work: here and now with one job, by `local_work`; else in processes that are started afresh ("spawn"), by what
    the picklable `make` gives each of them.

    A forked copy of a process with OpenCV's or BLAS's threads may hang, a spawned one does not. `window` pieces of work
    should be under way at a time. With one job, too, OpenCV works in one thread while this is open: some of its
    filters give other last digits in several, and a recording must be the same whatever the jobs.
    """

    def __init__(self, jobs: int, local_work: Work[T], make: Callable[[], Work[T]]) -> None:
        self._local_work, self._pool = local_work, None
        self.window = 1 if jobs == 1 else 2 * jobs
        self._environment: dict[str, str | None] = {}
        self._threads = cv2.getNumThreads()
        self._before = set(multiprocessing.active_children())
        if jobs > 1:
            self._environment = {name: os.environ.get(name) for name in _THREADS}
            self._pool = ProcessPoolExecutor(
                jobs,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_start_worker,
                initargs=(make,),
            )

    def submit(self, object_id: str, number: int) -> Callable[[], T]:
        """Begin a piece of work; the callable waits for it. It raises the work's own RobotError, and a RobotError for
        any other failure in another process.
        """
        if self._pool is None:
            return functools.partial(self._local_work, object_id, number)
        os.environ.update(dict.fromkeys(_THREADS, "1"))  # read by the processes that a submission may start
        try:
            future = self._pool.submit(_run_work, object_id, number)
        except BrokenProcessPool as error:
            raise _worker_died() from error
        finally:
            _restore(self._environment)
        return functools.partial(_result, future, object_id, number)

    def __enter__(self) -> Self:
        cv2.setNumThreads(1)
        return self

    def __exit__(self, *_: object) -> None:
        """Waits for the work that has begun; the other is not done."""
        cv2.setNumThreads(self._threads)
        if self._pool is not None:
            _shut_down(self._pool, set(multiprocessing.active_children()) - self._before)


def _shut_down(pool: ProcessPoolExecutor, workers: Iterable[BaseProcess]) -> None:
    """Tell the workers to leave and wait until they have; Ctrl-C does not break that off, but is raised afterwards.

    A pool whose shutdown(wait=True) is broken off hangs when Python ends: the interrupted join of its thread makes that
    thread look finished (CPython issue 90882), so nobody waits until it has told the workers.
    """
    again: KeyboardInterrupt | None = None
    while True:
        try:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in workers:
                wait([worker.sentinel])
            break
        except KeyboardInterrupt as error:
            again = error
    if again is not None:
        raise again


def _restore(environment: dict[str, str | None]) -> None:
    for name, value in environment.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def _result(future: Future[T], object_id: str, number: int) -> T:
    try:
        return future.result()
    except RobotError:
        raise
    except BrokenProcessPool as error:
        raise _worker_died() from error
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise RobotError(f"attempt {number} at {object_id} broke off in a worker process: {reason}") from error


def _worker_died() -> RobotError:
    return RobotError(
        "a worker process died: it was killed, or memory ran out. What was recorded is whole; start again to go on, "
        "with fewer jobs if memory is short"
    )


# In the worker ----------------------------------------------------------------------------------------------

_work: list[Work[Any]] = []
_make_work: list[Callable[[], Work[Any]]] = []


def _start_worker(make: Callable[[], Work[Any]]) -> None:
    """Runs first. Nothing here may fail: a pool does not say why. Ctrl-C is the parent's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    _make_work.append(make)


def _exit_with_parent() -> None:
    """A parent that is killed cannot end its workers, which would wait for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _run_work(object_id: str, number: int) -> Any:
    if not _work:
        _work.append(_make_work[0]())
    return _work[0](object_id, number)
