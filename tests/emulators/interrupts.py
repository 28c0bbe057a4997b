"""Ctrl-C and SIGTERM, for programs that serve until one of them comes."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def until_interrupted() -> Iterator[None]:
    """Ctrl-C or SIGTERM leaves what is inside, and the program goes on after it. For the main thread.

    Also where it was started to ignore Ctrl-C, as a shell does with what it starts by `&`.
    """
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    except KeyboardInterrupt:
        return
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
