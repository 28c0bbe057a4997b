"""Reading files that others name: only regular files are opened to be read, so that no pipe blocks and no device is
read for ever."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

MOST_BYTES = 512 * 2**20
"""Of what is read whole."""

_WORDS = {
    stat.S_IFIFO: "is a pipe",
    stat.S_IFSOCK: "is a socket",
    stat.S_IFCHR: "is a device",
    stat.S_IFBLK: "is a device",
}


def open_regular(path: str | Path) -> BinaryIO:
    """A regular file, opened to be read. Raises OSError, whose `strerror` says what stands there instead."""
    _require_regular(os.stat(path).st_mode, path)
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # what was swapped since does not block
    try:
        _require_regular(os.fstat(descriptor).st_mode, path)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_regular(path: str | Path, most: int = MOST_BYTES) -> bytes:
    """The bytes of a regular file of at most `most` bytes. Raises OSError."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size <= most:
            data = file.read(most + 1)
            size = max(size, len(data))
    if size > most:
        raise OSError(errno.EINVAL, f"has {size} bytes; at most {most} are read", str(path))
    return data


def _require_regular(mode: int, path: str | Path) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "is a folder, not a file", str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, f"{_WORDS.get(stat.S_IFMT(mode), 'is no file')}, not a regular file", str(path))
