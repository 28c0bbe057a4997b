"""The writer lock of an index, which the operating system releases when the writer ends or is killed."""

import fcntl
import os
import stat
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from indexes.errors import LockedIndex, WriteFailed


class WriterLock:
    """A lock file: `with WriterLock(path):` locks it for this process, or raises `LockedIndex` immediately.

    The block may enter the lock again. The file stays after the release and contains the process id of the last
    writer, for messages; a file that exists is not necessarily locked.
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
            if holder and not (holder.isdigit() and len(holder) <= 32):  # a file of the user
                raise WriteFailed(
                    f"{self.path} is not the lock file of an index and was not changed; give another folder"
                )
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(descriptor)
            who = f"process {holder}" if holder else "an unknown process"
            message = (
                f"{self.path.parent}: only one writer at a time is allowed, and {who} is writing. Wait until it ends"
            )
            raise LockedIndex(message) from error
        except (OSError, WriteFailed) as error:
            os.close(descriptor)
            if isinstance(error, WriteFailed):
                raise
            raise WriteFailed(
                f"{self.path}: this disk does not support locks ({error.strerror}); build the index on another disk"
            ) from error
        with suppress(OSError):  # a full disk may have no room for the process id; the lock works without it
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"{os.getpid()}\n".encode())
        return descriptor


def _open_lock_file(path: Path) -> int:
    """Open a lock file, created if missing; links are refused and pipes do not block. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
