"""Reading files that others name: only regular files are opened to be read, so that no pipe blocks and no device is
read for ever."""

import errno
import json
import os
import stat
from collections.abc import Iterable
from io import BufferedReader
from pathlib import Path
from typing import Any

DEEPEST = 64
"""Levels of lists and objects inside one another; what reads or shows JSON by recursion ends somewhere beyond."""
MOST_BYTES = 512 * 2**20
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


def read_json(path: str | Path, most: int = MAX_JSON_BYTES) -> Any:
    """Return the JSON document in a regular file of at most `most` bytes; a larger one is not read.

    Raises OSError, and ValueError as `parse_json` does.
    """
    return parse_json(read_regular(path, most))


def parse_json(text: str | bytes) -> Any:
    """Return a JSON document. Raises ValueError for what is none, repeats a key, or is nested deeper than `DEEPEST`."""
    try:
        document = json.loads(text, object_pairs_hook=_object)
    except RecursionError as error:
        raise ValueError(f"it is nested deeper than {DEEPEST} levels") from error
    if is_deep(document):
        raise ValueError(f"it is nested deeper than {DEEPEST} levels")
    return document


def is_deep(document: Any) -> bool:
    """Whether JSON has more than `DEEPEST` lists or objects inside one another."""
    level = [document]
    for _ in range(DEEPEST):
        level = [inner for each in level if isinstance(each, dict | list | tuple) for inner in _inside(each)]
    return any(isinstance(each, dict | list | tuple) for each in level)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it has the key {next(name for name in names if names.count(name) > 1)!r} twice")
    return found


def _inside(each: Any) -> Iterable[Any]:
    return each.values() if isinstance(each, dict) else each


def _require_regular(mode: int, path: str | Path) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "is a folder, not a file", str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, f"{_WORDS.get(stat.S_IFMT(mode), 'is no file')}, not a regular file", str(path))
