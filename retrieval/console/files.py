"""Files that commands write: whole or not at all, and never over a file of another kind."""

import os
import stat
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from _touch_retrieval.files import named_write_errors, open_regular, parse_json, write_atomically
from retrieval.errors import BadInput

GENERATOR = "touch-retrieval"
"""What our pages, texts and pictures say that they were made by."""
GENERATOR_COMMENT = f"<!-- {GENERATOR} -->"
"""Stands on top of our reports in Markdown."""
HEADER = "touch_retrieval"
"""Our entry among the metadata of a `.safetensors` file."""
SEAL = b"touch_retrieval.sha256"
"""Stands near the end of our ONNX files."""
_HEAD = 4096
_MAX_HEADER_BYTES = 100_000_000  # what safetensors itself reads


def cache_folder() -> Path | None:
    """What may be made or fetched again is kept here: `$XDG_CACHE_HOME/touch-retrieval` (`~/.cache` where it is not
    set). None where the user has no home.
    """
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return Path(home) / "touch-retrieval"


def make_cache_folder(folder: Path) -> None:
    """Make the cache folder with mode 0700, whatever the umask. One that exists stays as it is. Raises OSError."""
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
        folder.chmod(0o700)


def require_private(path: Path, status: os.stat_result, *owners: int) -> None:
    """Raise BadInput unless `path` belongs to this user, to root or to one of `owners` (user ids), and nobody else can
    write to it.

    status: of the opened file, so that nothing is swapped between this check and the reading.
    """
    if status.st_uid not in {0, os.geteuid(), *owners}:
        raise BadInput(f"{path} belongs to another user (uid {status.st_uid})")
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        mode = stat.S_IMODE(status.st_mode)
        raise BadInput(f"{path} can be written to by other users (mode {mode:04o}; `chmod go-w` takes that away)")


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
    about = _parsed(file.read(length) if length <= _MAX_HEADER_BYTES else b"").get("__metadata__")
    return isinstance(about, dict) and HEADER in about


def _holds(*keys: str) -> Callable[[BinaryIO], bool]:
    return lambda file: set(keys) <= set(_parsed(file.read(_MAX_HEADER_BYTES)))


def _parsed(text: bytes) -> dict[str, Any]:
    """The JSON object that a text holds; an empty one where it holds none."""
    try:
        found = parse_json(text)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


PAGE = Kind("a page", _begins_with(f'content="{GENERATOR}"'))
CARD = Kind("a model card", _begins_with("\n\nMatches touches of "))
TEXT = Kind("a report", _begins_with(GENERATOR_COMMENT))
CHECKPOINT = Kind("a checkpoint", _has_header)
EXPORT = Kind("an export", _ends_with_seal)
RESULTS = Kind("results", _holds("software"))
TIMINGS = Kind("timings", _holds("machine", "methods"))
HAND_EYE = Kind("a hand-eye calibration", _holds("rigid", "points"))
PREVIEW = Kind("a preview", _begins_with(GENERATOR))


def require_ours(path: Path, kind: Kind) -> None:
    """Raise BadInput unless nothing stands at `path`, or an empty file, or one of that kind: another one is of the
    user, who gave the wrong name. Asked before the work whose result is to be written there.
    """
    try:
        with open_regular(path) as file:
            if not os.fstat(file.fileno()).st_size or kind.is_ours(file):
                return
    except (FileNotFoundError, NotADirectoryError):  # what is wrong with its folder is said when it is written
        return
    except OSError as error:
        why = error.strerror or str(error)
        why = why if why.startswith(("is ", "has ")) else f"cannot be opened ({why})"
        raise BadInput(f"{path} {why}; name a file to write {kind.name} to") from error
    raise BadInput(
        f"{path} is not {kind.name} that this program wrote, and is left as it is; name another file, or move it away"
    )


def require_folder(path: Path) -> None:
    """Raise BadInput unless the folder of a file to write exists: a wrong path is more likely than a wish for it."""
    if not path.parent.is_dir():
        raise BadInput(f"{path} cannot be written, as there is no folder {path.parent}; make it, or name another file")


def write_output(path: Path, data: bytes, kind: Kind) -> None:
    """Write what a command was asked for, its folder too; see `require_ours` and `write_atomically`."""
    require_ours(path, kind)
    with named_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data)


def text_bytes(text: str) -> bytes:
    """The text of a page in UTF-8; characters that UTF-8 cannot hold (of names in unknown coding) become HTML's numeric
    references.
    """
    return text.encode("utf-8", "xmlcharrefreplace")
