"""Output files of commands, and the user's cache folder."""

import os
import stat
from contextlib import suppress
from pathlib import Path

from _touch_retrieval.files import named_write_errors, write_atomically
from retrieval.errors import BadInput

SEAL = b"touch_retrieval.sha256"
"""Key near the end of our ONNX files."""


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


def require_output(path: Path, suffix: str) -> None:
    """Check that a command may write its output to a file, before the work for it begins.

    An existing file with this suffix is replaced. The suffix protects photos and gel images.

    Args:
        path: The file to write.
        suffix: Suffix of the command's output, such as ".html".

    Raises:
        BadInput: `path` has another suffix, is a folder, or its folder does not exist.
    """
    if path.suffix != suffix:
        raise BadInput(f"{path} must be named *{suffix}. Name another file.")
    if path.is_dir():
        raise BadInput(f"{path} is a folder. Name a file.")
    if not path.parent.is_dir():  # more likely a typing error than intended
        raise BadInput(
            f"{path} cannot be written: the folder {path.parent} does not exist. Create it, or name another file."
        )


def write_output(path: Path, data: bytes) -> None:
    """Write an output file of a command atomically, and create its folder.

    Raises:
        OSError: The file cannot be written. The error contains `path`.
    """
    with named_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data)


def text_bytes(text: str) -> bytes:
    """Return the text of a page in UTF-8.

    Surrogates, from file names in unknown encodings, become numeric character references of HTML.
    """
    return text.encode("utf-8", "xmlcharrefreplace")
