"""Crash-safe files: write the whole content, flush it to the disk, then rename.

A replacement is written in the same folder under a hidden name that ends in .tmp, and then renamed.

Only regular files are opened for reading: a pipe cannot block the reader, and no device is read without end.
"""

import errno
import hashlib
import json
import math
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

_UNFLUSHED = (errno.EACCES, errno.EPERM, errno.EINVAL, errno.ENOTSUP)
"""Errors of folders that are writable but not readable, and of disks that cannot flush folders."""


@contextmanager
def durable_file(path: Path) -> Iterator[BinaryIO]:
    """Open a new file for writing, and flush it to the disk when the block ends."""
    with path.open("wb") as handle:
        yield handle
        finish(handle)


def finish(handle: BinaryIO) -> None:
    """Flush a file to the disk and close it."""
    handle.flush()
    os.fsync(handle.fileno())
    handle.close()


def sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file: after a power failure it has either all of `data` or its old content.

    Args:
        path: The file. If it is a link, its target is replaced.
        data: The new content.

    Raises:
        OSError: The file cannot be written. The error contains `path`.
    """
    with named_write_errors(path), atomic_file(path) as file:
        file.write(data)


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file that replaces `path` when the block ends (`write_atomically`); after an error nothing changes."""
    place = path.resolve() if path.is_symlink() else path
    short = os.fsdecode(os.fsencode(place.name)[:200])  # for the longest names that disks allow
    temporary = place.with_name(f".{short}.{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as file:
            yield file
            finish(file)
        temporary.replace(place)
    finally:
        temporary.unlink(missing_ok=True)
    try:
        sync(place.parent)
    except OSError as error:
        if error.errno not in _UNFLUSHED:
            raise


@contextmanager
def named_write_errors(path: Path) -> Iterator[None]:
    """Add the name of the written file to errors of the block: a failed write does not contain it."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, f"cannot be written: {error.strerror or error}", str(path)) from error
    except RuntimeError as error:  # a link that leads to itself
        raise OSError(errno.ELOOP, "cannot be written: its links form a circle", str(path)) from error


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


def encoded(document: Any, *, indent: int | None = None) -> bytes:
    """Return JSON in UTF-8. Text that UTF-8 cannot represent (file names of unknown encoding) is escaped."""
    try:
        return json.dumps(document, ensure_ascii=False, allow_nan=False, indent=indent).encode()
    except UnicodeEncodeError:
        return json.dumps(document, allow_nan=False, indent=indent).encode()


MAX_DEPTH = 64
"""Largest number of nested lists and objects. Recursive readers and writers of JSON fail at some larger depth."""
MAX_FILE_BYTES = 512 * 2**20
"""Largest file that is read as a whole."""
MAX_JSON_BYTES = 64 * 2**20
"""Default limit of a JSON file. A parsed document takes up to 25 times as much memory."""


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading. Raises OSError; its `strerror` says that any other file is not one."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # a pipe does not block
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, "is a folder, not a file", str(path))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "is a pipe, a device or a socket, not a regular file", str(path))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_regular(path: str | Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a regular file of at most `max_bytes` bytes. Raises OSError."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size <= max_bytes:
            data = file.read(max_bytes + 1)
            size = max(size, len(data))
    if size > max_bytes:
        raise OSError(errno.EINVAL, f"has {size} bytes; at most {max_bytes} are allowed", str(path))
    return data


def read_json(path: str | Path, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Return the JSON document in a regular file.

    Args:
        path: The file.
        max_bytes: Largest size; a larger file is an error.

    Raises:
        OSError: The file is not regular, cannot be read or is too large.
        ValueError: It is not a valid document (`parse_json`).
    """
    return parse_json(read_regular(path, max_bytes))


def parse_json(text: str | bytes, *, finite: bool = False) -> Any:
    """Return the document in a JSON text.

    Args:
        text: The JSON.
        finite: Reject numbers that are not finite, which Python accepts: NaN, Infinity and 1e999.

    Raises:
        ValueError: The text is not JSON, has a key twice, or is nested deeper than `MAX_DEPTH`.
    """
    number = _finite if finite else None
    try:
        document = json.loads(text, object_pairs_hook=_object, parse_constant=number, parse_float=number)
    except RecursionError as error:
        raise ValueError(f"it is nested deeper than {MAX_DEPTH} levels") from error
    if is_deep(document):
        raise ValueError(f"it is nested deeper than {MAX_DEPTH} levels")
    return document


def is_deep(document: Any) -> bool:
    """Whether a document is nested deeper than `MAX_DEPTH` levels."""
    level = [document]
    for _ in range(MAX_DEPTH):
        level = [
            inner
            for each in level
            if isinstance(each, dict | list | tuple)
            for inner in (each.values() if isinstance(each, dict) else each)
        ]
    return any(isinstance(each, dict | list | tuple) for each in level)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it has the key {next(name for name in names if names.count(name) > 1)!r} twice")
    return document


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not a finite number")
    return number
