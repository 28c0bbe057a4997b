"""Crash-safe files: write the whole content, flush it to the disk, then rename.

A replacement is written in the same folder under a hidden name that ends in .tmp, and then renamed.

Only regular files are opened for reading: a pipe cannot block the reader, and no device is read without end.
"""

import errno
import hashlib
import json
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from _touch_retrieval.text import decode_text


@contextmanager
def durable_file(path: Path) -> Iterator[BinaryIO]:
    """Open a new file for writing, and flush it to the disk when the block ends."""
    with path.open("wb") as handle:
        yield handle
        handle.flush()
        os.fsync(handle.fileno())


def sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file, or the target of a link: after a power failure it has either all of `data` or its old content.

    Raises:
        OSError: The file cannot be written. The error contains `path`.
    """
    try:
        with atomic_file(path) as file:
            file.write(data)
    except OSError as error:  # it names the temporary file, or none
        raise OSError(error.errno, f"cannot be written: {error.strerror}", str(path)) from error


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file that replaces `path` when the block ends (`write_atomically`); after an error nothing changes."""
    place = Path(os.path.realpath(path))
    temporary = place.with_name(f".{place.name[:50]}.{secrets.token_hex(8)}.tmp")
    try:
        with durable_file(temporary) as file:
            yield file
        temporary.replace(place)
    finally:
        temporary.unlink(missing_ok=True)
    with suppress(OSError):  # as in SQLite: some disks cannot flush a folder, and some folders cannot be read
        sync(place.parent)


def remove_folder(folder: Path) -> None:
    """Delete a folder. It is renamed first, so that a partly deleted folder is never mistaken for a complete one."""
    doomed = folder
    if ".tmp-" not in folder.name:
        doomed = folder.with_name(f"{folder.name}.tmp-{os.getpid()}")
        folder.rename(doomed)
    shutil.rmtree(doomed)


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a regular file in hexadecimal. Raises OSError."""
    with open_regular(path) as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading. Raises OSError; its `strerror` says that any other file is not one."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # a pipe does not block
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "is a folder, a pipe, a device or a socket, not a regular file", str(path))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_regular(path: str | Path, max_bytes: int = 512 * 2**20) -> bytes:
    """Return the content of a regular file of at most `max_bytes` bytes. Raises OSError."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size <= max_bytes:
            data = file.read(max_bytes + 1)
            size = max(size, len(data))
    if size > max_bytes:
        raise OSError(errno.EINVAL, f"has {size} bytes; at most {max_bytes} are allowed", str(path))
    return data


def read_json(path: str | Path) -> Any:
    """Return the JSON document in a regular file of at most 64 MiB, which takes up to 25 times as much memory.

    Raises OSError, ValueError.
    """
    return parse_json(read_regular(path, 64 * 2**20))


def parse_json(text: str | bytes, *, own: bool = False) -> Any:
    """Return the document in a JSON text.

    Args:
        text: The text; bytes as `decode_text` reads them.
        own: Whether `json.dumps` wrote it: it may contain paths that are not UTF-8, which msgspec refuses.

    Raises:
        ValueError: The text is not JSON, or is nested too deep.
    """
    try:
        if own:
            return json.loads(text)
        return msgspec.json.decode(decode_text(text) if isinstance(text, bytes) else text)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
