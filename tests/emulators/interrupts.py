"""Ctrl-C and SIGTERM, for programs that serve until one of them arrives."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def until_interrupted() -> Iterator[None]:
    """Leave the block on Ctrl-C or SIGTERM and continue after it. For the main thread.

    This also works if the process ignores Ctrl-C, as a shell sets it for processes started with `&`.
    """
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    except KeyboardInterrupt:
        return
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
