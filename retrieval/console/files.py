"""Output files of commands: written atomically, and never over a file of another kind."""

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
"""Generator name in our pages, texts and pictures."""
GENERATOR_COMMENT = f"<!-- {GENERATOR} -->"
"""First line of our Markdown reports."""
HEADER = "touch_retrieval"
"""Key of our entry in the metadata of a `.safetensors` file."""
SEAL = b"touch_retrieval.sha256"
"""Key near the end of our ONNX files."""
_HEAD = 4096
_MAX_HEADER_BYTES = 100_000_000  # the limit of safetensors


def cache_folder() -> Path | None:
    """Return the folder for files that can be created or downloaded again.

    Returns:
        `$XDG_CACHE_HOME/touch-retrieval`, by default under `~/.cache`; None if the user has no home folder.
    """
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return Path(home) / "touch-retrieval"


def make_cache_folder(folder: Path) -> None:
    """Create the cache folder with mode 0700, independent of the umask; an existing folder stays unchanged.

    Raises:
        OSError: The folder cannot be created.
    """
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
        folder.chmod(0o700)


def require_private(path: Path, status: os.stat_result, *owners: int) -> None:
    """Check that only trusted users can write to a file.

    Args:
        path: The file, for messages.
        status: Status of the opened file, so that the file cannot be swapped between this check and the reading.
        *owners: User ids that may own the file, in addition to this user and root.

    Raises:
        BadInput: Another user owns the file or can write to it.
    """
    if status.st_uid not in {0, os.geteuid(), *owners}:
        raise BadInput(f"{path} belongs to another user (uid {status.st_uid})")
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        mode = stat.S_IMODE(status.st_mode)
        raise BadInput(f"{path} can be written to by other users (mode {mode:04o}; run `chmod go-w` on it)")


@dataclass(frozen=True)
class Kind:
    """A kind of file that commands write.

    Attributes:
        name: Name of the kind for messages, with its article.
        is_ours: Whether an opened file is of this kind, by its content.
    """

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


def _has_keys(*keys: str) -> Callable[[BinaryIO], bool]:
    return lambda file: set(keys) <= set(_parsed(file.read(_MAX_HEADER_BYTES)))


def _parsed(text: bytes) -> dict[str, Any]:
    """Return the JSON object in a text, or an empty one."""
    try:
        document = parse_json(text)
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}


PAGE = Kind("a page", _begins_with(f'content="{GENERATOR}"'))
CARD = Kind("a model card", _begins_with("\n\nMatches touches of "))
TEXT = Kind("a report", _begins_with(GENERATOR_COMMENT))
CHECKPOINT = Kind("a checkpoint", _has_header)
EXPORT = Kind("an export", _ends_with_seal)
RESULTS = Kind("results", _has_keys("software"))
TIMINGS = Kind("timings", _has_keys("machine", "methods"))
HAND_EYE = Kind("a hand-eye calibration", _has_keys("rigid", "residuals_mm"))
PREVIEW = Kind("a preview", _begins_with(GENERATOR))


def require_ours(path: Path, kind: Kind) -> None:
    """Check that writing a file of this kind overwrites no other file; called before the work for it begins.

    Args:
        path: The file to write.
        kind: Its kind.

    Raises:
        BadInput: `path` exists, is not empty and is not of this kind.
    """
    try:
        with open_regular(path) as file:
            if not os.fstat(file.fileno()).st_size or kind.is_ours(file):
                return
    except (FileNotFoundError, NotADirectoryError):  # the writing reports problems of the folder
        return
    except OSError as error:
        reason = error.strerror or str(error)
        reason = reason if reason.startswith(("is ", "has ")) else f"cannot be opened ({reason})"
        raise BadInput(f"{path} {reason}. Name a file for {kind.name}.") from error
    raise BadInput(
        f"{path} is not {kind.name} that this program wrote, so it is not overwritten. Name another file, or move it."
    )


def require_folder(path: Path) -> None:
    """Check that the folder of an output file exists; a missing one is more likely a typing error than intended.

    Raises:
        BadInput: The folder does not exist.
    """
    if not path.parent.is_dir():
        raise BadInput(
            f"{path} cannot be written: the folder {path.parent} does not exist. Create it, or name another file."
        )


def write_output(path: Path, data: bytes, kind: Kind) -> None:
    """Write an output file of a command atomically, and create its folder.

    Args:
        path: The file.
        data: Its content.
        kind: Its kind; a file of another kind is not overwritten (`require_ours`).

    Raises:
        BadInput: A file of another kind exists at `path`.
        RetrievalError: The file cannot be written.
    """
    require_ours(path, kind)
    with named_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data)


def text_bytes(text: str) -> bytes:
    """Return the text of a page in UTF-8.

    Surrogates, from file names in unknown encodings, become numeric character references of HTML.
    """
    return text.encode("utf-8", "xmlcharrefreplace")
