"""List the files of a folder and its subfolders; links are followed without endless loops."""

import os
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path

from retrieval.data.text import is_utf8
from retrieval.errors import DatasetError


@dataclass(frozen=True)
class SkippedPhoto:
    """A file or folder that cannot be used, with the reason."""

    path: str
    reason: str


@dataclass
class FolderWalk:
    """The walk through a folder and its subfolders.

    Attributes:
        root: The folder.
        names: Files found so far, as posix paths relative to `root`.
        skipped: Files and folders that cannot be used.
        link_targets: Folders that links have led to.
    """

    root: Path
    names: list[str] = field(default_factory=list)
    skipped: list[SkippedPhoto] = field(default_factory=list)
    link_targets: set[Path] = field(default_factory=set)

    def walk(self, folder: str, prefix: str) -> None:
        """Add the files of a folder and its subfolders to `names`, with `prefix` before each name.

        A link to a folder is followed when it leads out of the catalogue. Each target is walked once, so links
        that form a loop cause no endless walk.

        Raises:
            DatasetError: The folder cannot be listed.
        """
        try:
            entries = sorted(os.scandir(folder), key=attrgetter("name"))
        except OSError as error:
            raise DatasetError(f"cannot list the catalogue folder {folder}: {error.strerror}") from error
        for entry in entries:
            name = entry.name
            if name.startswith("."):
                continue
            path = prefix + name
            if not path.isascii() and not is_utf8(path):
                printable = path.encode(errors="surrogateescape").decode(errors="backslashreplace")
                self.skipped.append(SkippedPhoto(printable, "the name is not valid UTF-8; rename it"))
                continue
            try:
                is_folder = entry.is_dir()
            except OSError:  # a link that leads to itself
                is_folder = False
            if not is_folder:
                self.names.append(path)
            elif entry.is_symlink():
                self._follow(entry.path, path)
            else:
                self.walk(entry.path, path + "/")

    def _follow(self, link: str, path: str) -> None:
        target = Path(os.path.realpath(link))
        if target.is_relative_to(self.root) or self.root.is_relative_to(target):
            self.skipped.append(SkippedPhoto(path, "a link into or around the catalogue itself is not followed"))
        elif target in self.link_targets:
            self.skipped.append(SkippedPhoto(path, f"a link to {target}, which another link has listed already"))
        else:
            self.link_targets.add(target)
            self.walk(link, path + "/")
