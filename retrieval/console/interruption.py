"""Handling of Ctrl-C: finish the current step first, say how to continue, or raise as usual and record the signal."""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from retrieval.errors import JobInterrupted


@contextmanager
def interruption() -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets; the second one raises KeyboardInterrupt as usual."""
    stop = threading.Event()

    def on_interrupt(number: int, frame: object) -> None:
        stop.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    with _handled([signal.SIGINT], on_interrupt):
        yield stop


@contextmanager
def record_interrupts() -> Iterator[list[int]]:
    """Yield the list of the Ctrl-C and SIGTERM signals so far.

    Each signal raises KeyboardInterrupt, so that a rig opens its gripper and closes, and a recording is complete. A
    signal during an import may surface as another error: a partly loaded numpy.linalg raises RecursionError.
    """
    signals: list[int] = []

    def on_interrupt(number: int, frame: object) -> None:
        signals.append(number)
        raise KeyboardInterrupt

    with _handled([signal.SIGINT, signal.SIGTERM], on_interrupt):
        yield signals


@contextmanager
def _handled(numbers: Sequence[int], handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Handle signals within the block; only the main thread of a process can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextmanager
def resumable(folder: Path) -> Iterator[None]:
    """Turn Ctrl-C into a JobInterrupted which says that the same command continues from the parts in `folder`."""
    try:
        yield
    except (KeyboardInterrupt, JobInterrupted) as error:
        raise JobInterrupted(
            f"Stopped. Finished parts are stored in {folder}; run the same command to continue."
        ) from error
