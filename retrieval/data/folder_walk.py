"""List the files of a folder and its subfolders; links are followed without endless loops."""

import os
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from retrieval.data.text import is_utf8
from retrieval.errors import DatasetError


@dataclass(frozen=True)
class SkippedPhoto:
    """A file or folder that cannot be used, with the reason."""

    path: str
    reason: str


def list_files(folder: Path) -> tuple[list[str], list[SkippedPhoto]]:
    """Return the files below a folder as posix paths relative to it, and what cannot be used.

    Names that start with a dot are left out. A link to a folder is followed if it leads out of `folder`. Each target is
    listed once, so links that form a loop cause no endless walk.

    Raises:
        DatasetError: A folder cannot be listed.
    """
    root = Path(os.path.realpath(folder))
    names: list[str] = []
    skipped: list[SkippedPhoto] = []
    targets: set[Path] = set()

    def walk(place: str, prefix: str) -> None:
        try:
            entries = sorted(os.scandir(place), key=attrgetter("name"))
        except OSError as error:
            raise DatasetError(f"cannot list the catalogue folder {place}: {error.strerror}") from error
        for entry in entries:
            path = prefix + entry.name
            if entry.name.startswith("."):
                continue
            if not path.isascii() and not is_utf8(path):
                printable = path.encode(errors="surrogateescape").decode(errors="backslashreplace")
                skipped.append(SkippedPhoto(printable, "the name is not valid UTF-8; rename it"))
            elif not os.path.isdir(entry):  # False for a link that leads to itself
                names.append(path)
            elif not entry.is_symlink():
                walk(entry.path, f"{path}/")
            elif (target := Path(os.path.realpath(entry.path))).is_relative_to(root) or root.is_relative_to(target):
                skipped.append(SkippedPhoto(path, "a link into or around the catalogue itself is not followed"))
            elif target in targets:
                skipped.append(SkippedPhoto(path, f"a link to {target}, which another link has listed already"))
            else:
                targets.add(target)
                walk(entry.path, f"{path}/")

    walk(str(folder), "")
    return names, skipped
