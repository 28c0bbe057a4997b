"""Output files of commands."""

from pathlib import Path

from _touch_retrieval.files import write_atomically
from retrieval.errors import BadInput


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


def write_output(path: Path, content: str | bytes) -> None:
    """Write an output file of a command atomically, and create its folder.

    Text is written in UTF-8; surrogates, from file names in unknown encodings, become character references of HTML.

    Raises:
        OSError: The file cannot be written. The error contains `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content if isinstance(content, bytes) else content.encode("utf-8", "xmlcharrefreplace"))
