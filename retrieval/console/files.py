"""Files that commands write: whole or not at all, and never over a file of another kind.

A file is written beside its place under a hidden name, flushed to the disk, and renamed. While it is written its
writer holds a lock on it, which the system drops when the writer dies: what a killed one left is swept by the next
write to the same name, on whichever host that runs and whatever process numbers have been given out since.
"""

import contextlib
import errno
import fcntl
import json
import os
import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from indexes.store.regular import open_regular
from retrieval.errors import BadInput

GENERATOR = "touch-retrieval"
"""What our pages, texts and pictures say that they were made by."""
MARKED = f"<!-- {GENERATOR} -->"
"""Stands on top of our reports in Markdown."""
HEADER = "touch_retrieval"
"""Our entry among the metadata of a `.safetensors` file."""
SEAL = b"touch_retrieval.sha256"
"""Stands near the end of our ONNX files."""
_HEAD = 4096
_ENDING = ".tmp"
_MOST_HEADER = 100_000_000  # what safetensors itself reads


@dataclass(frozen=True)
class Kind:
    """A kind of file that we write. is_ours: whether an opened file is one, by its content."""

    name: str
    is_ours: Callable[[BinaryIO], bool]


def _begins_with(*marks: str) -> Callable[[BinaryIO], bool]:
    def is_ours(file: BinaryIO) -> bool:
        head = file.read(_HEAD)
        return any(mark.encode() in head for mark in marks)

    return is_ours


def _ends_with_seal(file: BinaryIO) -> bool:
    file.seek(max(0, file.seek(0, os.SEEK_END) - _HEAD))
    return SEAL in file.read()


def _has_header(file: BinaryIO) -> bool:
    length = int.from_bytes(file.read(8), "little")
    about = _parsed(file.read(length) if length <= _MOST_HEADER else b"").get("__metadata__")
    return isinstance(about, dict) and HEADER in about


def _holds(*keys: str) -> Callable[[BinaryIO], bool]:
    return lambda file: set(keys) <= set(_parsed(file.read(_MOST_HEADER)))


def _parsed(text: bytes) -> dict[str, Any]:
    """A JSON object; nothing where it is none."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


PAGE = Kind("a page", _begins_with(f'content="{GENERATOR}"'))
CARD = Kind("a model card", _begins_with("\n\nMatches touches of "))
TEXT = Kind("a report", _begins_with(MARKED))
CHECKPOINT = Kind("a checkpoint", _has_header)
EXPORT = Kind("an export", _ends_with_seal)
RESULTS = Kind("results", _holds("software"))
TIMINGS = Kind("timings", _holds("machine", "methods"))
HAND_EYE = Kind("a hand-eye calibration", _holds("rigid", "points"))
PREVIEW = Kind("a preview", _begins_with(GENERATOR))


def require_ours(path: Path, kind: Kind) -> None:
    """Raise BadInput unless nothing stands at `path`, or an empty file, or one of that kind: another one is of the
    user, who gave the wrong name. Asked before the work whose result is to be written there."""
    try:
        with open_regular(path) as file:
            if not os.fstat(file.fileno()).st_size or kind.is_ours(file):
                return
    except (FileNotFoundError, NotADirectoryError):  # what is wrong with its folder is said when it is written
        return
    except OSError as error:
        raise BadInput(f"{path} {_why(error)}; name a file to write {kind.name} to") from error
    raise BadInput(
        f"{path} is not {kind.name} that this program wrote, and is left as it is; name another file, or move it away"
    )


def _why(error: OSError) -> str:
    reason = error.strerror or str(error)
    return reason if reason.startswith(("is ", "has ")) else f"cannot be opened ({reason})"


def write_output(path: Path, data: bytes, kind: Kind) -> None:
    """Write what a command was asked for, its folder too; see `require_ours` and `write_atomically`."""
    require_ours(path, kind)
    with _naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data)


def text_bytes(text: str) -> bytes:
    """A page in UTF-8; what UTF-8 cannot hold (names of unknown coding) as the references of HTML."""
    return text.encode("utf-8", "xmlcharrefreplace")


def write_atomically(path: Path, data: bytes) -> None:
    """Write beside, flush to disk, rename: `path` holds all of `data`, or what it held before. Where it is a link, the
    file that it leads to is written. Raises OSError that names `path`."""
    with _naming(path):
        place = path.resolve() if path.is_symlink() else path
        sweep(place)
        with _beside(place) as (temporary, descriptor):
            with open(descriptor, "wb", closefd=False) as file:
                file.write(data)
            os.fsync(descriptor)
            temporary.replace(place)


@contextlib.contextmanager
def _beside(path: Path) -> Iterator[tuple[Path, int]]:
    """A new file beside `path`, locked as long as it is written; gone afterwards unless it was renamed."""
    while True:
        name = path.with_name(f"{_beginning(path)}{secrets.token_hex(8)}{_ENDING}")
        descriptor = os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            with contextlib.suppress(OSError):  # on a disk without locks nobody sweeps either
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            if not os.fstat(descriptor).st_nlink:  # swept before it was locked
                continue
            yield name, descriptor
            return
        finally:
            name.unlink(missing_ok=True)
            os.close(descriptor)


def sweep(path: Path) -> None:
    """Delete what killed writers of `path` left beside it."""
    with contextlib.suppress(OSError), os.scandir(path.parent) as entries:
        left = [one.path for one in entries if one.name.startswith(_beginning(path)) and one.name.endswith(_ENDING)]
        for name in left:
            _delete_unless_locked(name)


def _delete_unless_locked(name: str) -> None:
    with contextlib.suppress(OSError), open_regular(name) as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(file.fileno()), os.lstat(name)):
            os.unlink(name)


def _beginning(path: Path) -> str:
    """Of the hidden names beside `path`, short enough for every disk."""
    return f".{os.fsdecode(os.fsencode(path.name)[:200])}."


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """What the disk refuses, with the name of the file that was to be written: a write alone does not tell it."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, f"cannot be written: {error.strerror or error}", str(path)) from error
    except RuntimeError as error:  # of a link that leads to itself
        raise OSError(errno.ELOOP, "cannot be written: its links go round in a circle", str(path)) from error
