"""Handling of Ctrl-C: finish the current step first, say how to continue, or raise as usual and record the signal."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from retrieval.errors import JobInterrupted


@contextmanager
def interruption() -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets; the second one raises KeyboardInterrupt as usual."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def on_interrupt(number: int, frame: object) -> None:
        stop.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def resumable(folder: Path) -> Iterator[None]:
    """Say after Ctrl-C that the same command continues the job, which stores each finished part (`Cache`, recordings).

    Args:
        folder: Folder of the finished parts.

    Raises:
        JobInterrupted: After Ctrl-C.
    """
    try:
        yield
    except (KeyboardInterrupt, JobInterrupted) as error:
        raise JobInterrupted(
            f"Stopped. Finished parts are stored in {folder}; run the same command to continue."
        ) from error


@contextmanager
def record_interrupts() -> Iterator[list[int]]:
    """Yield the list of the Ctrl-C and SIGTERM signals so far.

    Each signal raises KeyboardInterrupt, so that a rig opens its gripper and closes, and a recording is complete. A
    signal during an import may surface as another error: a partly loaded numpy.linalg raises RecursionError.
    """
    signals: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield signals
        return

    def on_interrupt(number: int, frame: object) -> None:
        signals.append(number)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, on_interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
