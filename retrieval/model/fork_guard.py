"""One guard for forks: a process forks when no touch is read or encoded, and the child starts without open sessions.

A fork copies locks of libraries that other threads hold, but not the threads that would release them.
"""

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from weakref import WeakSet

MAX_FORK_WAIT_S = 10.0
"""Longest wait for computations to end before a fork."""


class ForkGuard:
    """Delays a fork until no touch is read or encoded, and closes `sessions`, which have threads, before it."""

    def __init__(self) -> None:
        self.sessions: WeakSet[Any] = WeakSet()
        self._idle, self._computing, self._threads = threading.Condition(), 0, set[int]()

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Mark a block during which no fork may happen."""
        with self._idle:
            self._computing += 1
            self._threads.add(threading.get_native_id())
        try:
            yield
        finally:
            with self._idle:
                self._computing -= 1
                self._idle.notify_all()

    def before(self) -> None:
        """Wait for computations to end, block new ones until the fork is done, and close the sessions.

        A thread that Python has joined still returns its memory for a while, under an allocator's lock.
        """
        self._idle.acquire()
        deadline = time.monotonic() + MAX_FORK_WAIT_S
        self._idle.wait_for(lambda: self._computing == 0, MAX_FORK_WAIT_S)
        for session in self.sessions:
            session.close()
        alive = {thread.native_id for thread in threading.enumerate()}
        for ended in self._threads - alive:
            while os.path.exists(f"/proc/self/task/{ended}") and time.monotonic() < deadline:
                time.sleep(1e-3)
        self._threads &= alive

    def after_in_parent(self) -> None:
        """Let other threads continue."""
        self._idle.release()

    def after_in_child(self) -> None:
        """Reset the state: the child computes nothing yet, and has none of PyTorch's threads."""
        self._idle, self._computing, self._threads = threading.Condition(), 0, set()
        if "torch" in sys.modules:
            sys.modules["torch"].set_num_threads(1)


fork_guard = ForkGuard()
os.register_at_fork(
    before=fork_guard.before, after_in_parent=fork_guard.after_in_parent, after_in_child=fork_guard.after_in_child
)
