"""What builds saw in folders: one that looks as it did holds the names that it held, and need not be listed again.

    seen.folders    of each folder without folders and links in it: how it looked, its path, and its names

Each is a fact of its own, "a folder that looks so holds these names", as those of `indexes.store.seen` are of files;
the file may be deleted at any time, and one that was altered or cut short is none. A folder's times change with its
names on the disks of a machine; what lies on no block device, as what a network or a program shows, is not noted.
"""

import hashlib
import os
import struct
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from _touch_retrieval import files
from _touch_retrieval.files import read_regular
from indexes.store.seen import SETTLED_NS

NAME = "seen.folders"

_MAGIC = b"folders 1\n"
_LOOK = struct.Struct("<4Q")
_COUNT = struct.Struct("<Q")
_MASK = 2**64 - 1
_MOST_BYTES = 2**33


class SeenFolders:
    """The notes in the folder of an index, and those that a listing makes for the next one.

    Made before the listing begins. known: whether what was noted is to be believed.
    """

    def __init__(self, index: Path, known: bool = True) -> None:
        self._path, self._settled = index / NAME, time.time_ns() - SETTLED_NS
        self._before = self._read()
        self._known = self._before if known else {}
        self._now: dict[str, tuple[bytes, str]] = {}

    def look(self, folder: str) -> bytes:
        """How a folder looks, before it is listed; nothing where that cannot be told."""
        try:
            found = os.stat(folder)
        except OSError:  # listing it will say why
            return b""
        return _LOOK.pack(found.st_mtime_ns & _MASK, found.st_ctime_ns & _MASK, found.st_ino, found.st_dev & _MASK)

    def names(self, path: str, look: bytes) -> list[str] | None:
        """What the folder at this path, relative to the catalogue, holds by its look; None where it must be listed."""
        noted = self._known.get(path)
        if noted is None or noted[0] != look:
            return None
        self._now[path] = noted
        return noted[1].split("/") if noted[1] else []

    def note(self, path: str, look: bytes, names: Sequence[str]) -> None:
        """Note the names of what a folder holds, which are neither folders nor links, and valid UTF-8. One that has
        changed just now may do so again within a tick of its clock, and is not noted."""
        if sys.platform == "linux" and look:
            modified, changed, _, device = _LOOK.unpack(look)
            if os.major(device) and max(modified, changed) < self._settled:
                self._now[path] = look, "/".join(names)

    def write(self) -> None:
        """Put what was noted in the place of what had been. Raises OSError where the disk refuses."""
        if self._now != self._before:
            texts = "\0".join(f"{path}\0{names}" for path, (_, names) in self._now.items())
            looks = b"".join(look for look, _ in self._now.values())
            content = b"".join([_MAGIC, _COUNT.pack(len(self._now)), looks, texts.encode()])
            files.write_atomically(self._path, content + hashlib.sha256(content).digest())

    def _read(self) -> dict[str, tuple[bytes, str]]:
        try:
            content = read_regular(self._path, _MOST_BYTES)
        except OSError:
            return {}
        body, check = content[:-32], content[-32:]
        if not body.startswith(_MAGIC) or hashlib.sha256(body).digest() != check:
            return {}
        try:
            start = len(_MAGIC) + _COUNT.size
            stop = start + _LOOK.size * int(_COUNT.unpack_from(body, len(_MAGIC))[0])
            looks = (body[at : at + _LOOK.size] for at in range(start, stop, _LOOK.size))
            texts = body[stop:].decode().split("\0") if stop > start else []
            noted = zip(looks, texts[1::2], strict=True)
            return dict(zip(texts[::2], noted, strict=True))
        except (ValueError, struct.error):  # forged
            return {}
