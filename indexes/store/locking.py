"""One writer at a time: a lock that the operating system drops when its holder dies."""

import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from indexes.errors import LockedIndex, WriteFailed


class WriterLock:
    """`with WriterLock(path):` holds the lock file for this process, or raises `LockedIndex` at once.

    Entering it again inside the block is allowed. The file stays when the lock is given up; it holds the last
    holder's process id for messages, and means nothing by being there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._depth = 0
        self._descriptor = -1

    def __enter__(self) -> Self:
        if self._depth == 0:
            self._descriptor = self._take()
        self._depth += 1
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._depth -= 1
        if self._depth == 0:
            os.close(self._descriptor)

    def _take(self) -> int:
        try:
            descriptor = _open_lock_file(self.path)
        except OSError as error:
            raise WriteFailed(f"{self.path}: the lock file cannot be opened; {error.strerror}") from error
        try:
            is_file = stat.S_ISREG(os.fstat(descriptor).st_mode)
            holder = os.pread(descriptor, 33, 0).decode("ascii", "replace").strip() if is_file else "no file"
            if holder and not (holder.isdigit() and len(holder) <= 32):  # of the user
                raise WriteFailed(
                    f"{self.path} is not the lock file of an index, and stays as it is; give another folder"
                )
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(descriptor)
            who = f"process {holder}" if holder else "an unknown process"
            message = f"{self.path.parent}: one writer at a time; {who} is writing. Wait for it to end"
            raise LockedIndex(message, int(holder) if holder else None) from error
        except (OSError, WriteFailed) as error:
            os.close(descriptor)
            if isinstance(error, WriteFailed):
                raise
            raise WriteFailed(
                f"{self.path}: this disk keeps no locks ({error.strerror}); build the index on another one"
            ) from error
        with suppress(OSError):  # a full disk may lack the room for who it is: the lock is held all the same
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"{os.getpid()}\n".encode())
        return descriptor


def _open_lock_file(path: Path) -> int:
    """A lock file, made where there is none; a link is refused, and a pipe blocks nobody. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)


@contextmanager
def exclusive_lock(path: Path) -> Iterator[None]:
    """The block runs when no other one does that was given the same lock file, in whatever process. Raises OSError."""
    descriptor = _open_lock_file(path)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
