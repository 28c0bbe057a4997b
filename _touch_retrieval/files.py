"""Files that survive a crash: written whole, flushed to the disk, and named only then.

A file that replaces another is written beside its place under a hidden name and renamed. While it is written its writer
holds a lock on it, which the system drops when the writer dies: what a killed one left is swept by the next write to
the same name, on whichever host that runs and whatever process numbers have been given out since.

Only regular files are opened to be read, so that no pipe blocks and no device is read for ever.
"""

import errno
import fcntl
import hashlib
import json
import math
import os
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

_ENDING = ".tmp"
_UNFLUSHED = (errno.EACCES, errno.EPERM, errno.EINVAL, errno.ENOTSUP)
"""Of a folder that may be written to but not read, and of disks that flush no folders."""


@contextmanager
def durable_file(path: Path) -> Iterator[BinaryIO]:
    """A new file to write; flushed to the disk when the block ends."""
    with path.open("wb") as handle:
        yield handle
        finish(handle)


def finish(handle: BinaryIO) -> None:
    """Flush what was written to the disk, and close the file."""
    handle.flush()
    os.fsync(handle.fileno())
    handle.close()


def sync(path: Path) -> None:
    """Flush a file or a folder (its names) to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_atomically(path: Path, data: bytes) -> None:
    """Write beside, flush to disk, rename: `path` holds all of `data`, or what it held before, whenever the power
    fails. Where it is a link, the file that it leads to is written. Raises OSError that names `path`.
    """
    with named_write_errors(path), atomic_file(path) as file:
        file.write(data)


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write what `path` shall hold, as `write_atomically` does it, piece by piece; where the block raises,
    `path` stays as it was.
    """
    place = path.resolve() if path.is_symlink() else path
    _sweep(place)
    with _temporary_file(place) as (temporary, descriptor):
        with open(descriptor, "wb", closefd=False) as file:
            yield file
        os.fsync(descriptor)
        temporary.replace(place)
    try:
        sync(place.parent)
    except OSError as error:
        if error.errno not in _UNFLUSHED:
            raise


@contextmanager
def named_write_errors(path: Path) -> Iterator[None]:
    """What the disk refuses, with the name of the file that was to be written: a write alone does not tell it."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, f"cannot be written: {error.strerror or error}", str(path)) from error
    except RuntimeError as error:  # of a link that leads to itself
        raise OSError(errno.ELOOP, "cannot be written: its links go round in a circle", str(path)) from error


@contextmanager
def _temporary_file(path: Path) -> Iterator[tuple[Path, int]]:
    """A new file beside `path`, locked as long as it is written; gone afterwards unless it was renamed."""
    while True:
        name = path.with_name(f"{_temporary_prefix(path)}{secrets.token_hex(8)}{_ENDING}")
        descriptor = os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            with suppress(OSError):  # on a disk without locks nobody sweeps either
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            if not os.fstat(descriptor).st_nlink:  # swept before it was locked
                continue
            yield name, descriptor
            return
        finally:
            name.unlink(missing_ok=True)
            os.close(descriptor)


def _sweep(path: Path) -> None:
    """Delete what killed writers of `path` left beside it."""
    with suppress(OSError), os.scandir(path.parent) as entries:
        left = [
            one.path for one in entries if one.name.startswith(_temporary_prefix(path)) and one.name.endswith(_ENDING)
        ]
        for name in left:
            _delete_unless_locked(name)


def _delete_unless_locked(name: str) -> None:
    with suppress(OSError), open_regular(name) as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(file.fileno()), os.lstat(name)):
            os.unlink(name)


def _temporary_prefix(path: Path) -> str:
    """Of the hidden names beside `path`, short enough for every disk."""
    return f".{os.fsdecode(os.fsencode(path.name)[:200])}."


def remove_folder(folder: Path) -> None:
    """Delete a folder; renamed first, so that a half-deleted one is never taken for a whole one."""
    doomed = folder
    if ".tmp-" not in folder.name:
        doomed = folder.with_name(f"{folder.name}.tmp-{os.getpid()}")
        folder.rename(doomed)
    shutil.rmtree(doomed)


def file_digest(path: Path) -> str:
    """SHA-256 of a regular file, in hexadecimal. Raises OSError."""
    with open_regular(path) as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def encoded(document: Any, *, indent: int | None = None) -> bytes:
    """JSON in UTF-8. Text that UTF-8 cannot hold (file names of unknown coding) is escaped."""
    try:
        return json.dumps(document, ensure_ascii=False, allow_nan=False, indent=indent).encode()
    except UnicodeEncodeError:
        return json.dumps(document, allow_nan=False, indent=indent).encode()


MAX_DEPTH = 64
"""Levels of lists and objects inside one another; what reads or shows JSON by recursion ends somewhere beyond."""
MAX_FILE_BYTES = 512 * 2**20
"""Of what is read whole."""
MAX_JSON_BYTES = 64 * 2**20
"""Of a JSON file whose reader states no tighter limit; parsed, it takes up to 25 times as much memory."""

_WORDS = {
    stat.S_IFIFO: "is a pipe",
    stat.S_IFSOCK: "is a socket",
    stat.S_IFCHR: "is a device",
    stat.S_IFBLK: "is a device",
}


def open_regular(path: str | Path) -> BufferedReader:
    """A regular file, opened to be read. Raises OSError, whose `strerror` says what stands there instead."""
    _require_regular(os.stat(path).st_mode, path)
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # what was swapped since does not block
    try:
        _require_regular(os.fstat(descriptor).st_mode, path)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_regular(path: str | Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """The bytes of a regular file of at most `max_bytes` bytes. Raises OSError."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size <= max_bytes:
            data = file.read(max_bytes + 1)
            size = max(size, len(data))
    if size > max_bytes:
        raise OSError(errno.EINVAL, f"has {size} bytes; at most {max_bytes} are read", str(path))
    return data


def read_json(path: str | Path, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Return the JSON document in a regular file of at most `max_bytes` bytes; a larger one is not read.

    Raises OSError, and ValueError as `parse_json` does.
    """
    return parse_json(read_regular(path, max_bytes))


def parse_json(text: str | bytes, *, finite: bool = False) -> Any:
    """Return a JSON document. Raises ValueError for what is none, repeats a key, or is nested deeper than `MAX_DEPTH`.

    finite: refuse numbers that are not finite too, which Python reads: NaN, Infinity and 1e999.
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
    """Whether JSON has more than `MAX_DEPTH` lists or objects inside one another."""
    level = [document]
    for _ in range(MAX_DEPTH):
        level = [inner for each in level if isinstance(each, dict | list | tuple) for inner in _inside(each)]
    return any(isinstance(each, dict | list | tuple) for each in level)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it has the key {next(name for name in names if names.count(name) > 1)!r} twice")
    return found


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not a finite number")
    return number


def _inside(each: Any) -> Iterable[Any]:
    return each.values() if isinstance(each, dict) else each


def _require_regular(mode: int, path: str | Path) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "is a folder, not a file", str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, f"{_WORDS.get(stat.S_IFMT(mode), 'is no file')}, not a regular file", str(path))
