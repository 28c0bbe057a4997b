"""The writer lock of an index, which the operating system releases when the writer ends or is killed."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from indexes.errors import LockedIndex, WriteFailed


@contextmanager
def writer_lock(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Lock a file for this process, or raise `LockedIndex` immediately. The file stays; its content is not changed.

    Args:
        path: The file, created with its folder if missing. A link in its place is refused.
        wait: Wait for another writer in place of raising `LockedIndex`.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except OSError as error:
        raise WriteFailed(f"{path}: the lock file cannot be opened; {error.strerror}") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            raise LockedIndex(f"{path.parent}: another writer is writing this index; wait until it ends") from error
        except OSError as error:
            raise WriteFailed(
                f"{path}: this disk does not support locks ({error.strerror}); build the index on another disk"
            ) from error
        yield
    finally:
        os.close(descriptor)
