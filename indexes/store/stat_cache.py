"""The stat cache: what builds saw of photos' files and folders. What looks as it did need not be read or listed again.

    files.stat      of each file the keys of its row's id and of its content's digest, its size, times and inode
    folders.stat    of each folder without folders and links in it its times, inode, device, and the names in it

Each entry is a fact of its own, "a file that looks so has this content", whatever generation is current. The files
belong to no generation and may be deleted at any time: then all is read once more. So it is where one was altered or
cut short, which the SHA-256 at its end tells.
"""

import hashlib
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from _touch_retrieval import files
from indexes.store.rows import KeyIndex

FILES, FOLDERS = "files.stat", "folders.stat"
MIN_AGE_NS = 2 * 10**9
"""An entry must have been left alone for so long: the coarsest clock of a common disk, FAT's, ticks every two
seconds."""
STATUS = ("bytes", "mtime_ns", "ctime_ns", "inode")
"""What the disk says of a file, each modulo 2^64."""
RECORD = np.dtype([("id", "S16"), ("digest", "S16"), ("status", "<u8", (len(STATUS),))])
_MAX_BYTES = 2**33

Keys: TypeAlias = NDArray[np.bytes_]
Statuses: TypeAlias = NDArray[np.uint64]
FolderStatus: TypeAlias = tuple[int, int, int, int]


class StatRecords:
    """The files' records in the folder of an index; use it under the index's lock. records (N,) of `RECORD`."""

    def __init__(self, index: Path) -> None:
        self._path = index / FILES
        body = _read(self._path)
        self.records = np.frombuffer(body, RECORD, count=len(body) // RECORD.itemsize)

    def digests(self, ids: Keys, statuses: Statuses) -> Keys:
        """For each file, by its row's id and its status (N, 4), the key of its content's digest; b"" where the status
        is another one than it was, or unknown.
        """
        found = np.zeros(len(ids), "S16")
        if len(self.records):
            number = KeyIndex(np.ascontiguousarray(self.records["id"])).find(ids)
            same = (number >= 0) & (self.records["status"][number] == statuses).all(axis=1)
            found[same] = self.records["digest"][number[same]]
        return found

    def write(self, ids: Keys, digests: Keys, statuses: Statuses) -> None:
        """Put these records (N,) in the place of all others. Raises OSError where the disk refuses."""
        before, self.records = self.records, np.zeros(len(ids), RECORD)
        self.records["id"], self.records["digest"], self.records["status"] = ids, digests, statuses
        if (body := self.records.tobytes()) != before.tobytes():
            _write(self._path, body)


class FolderCache:
    """The folders' entries in the folder of an index, and those that a listing makes for the next one.

    Made before the listing begins. known: whether the entries that are there are believed. A folder's times change with
    its names on the disks of a machine; folders on no block device, as those of a network or a program, get no entry.
    """

    def __init__(self, index: Path, known: bool = True) -> None:
        self._path, self._settled = index / FOLDERS, time.time_ns() - MIN_AGE_NS
        try:
            self._before = msgspec.msgpack.decode(_read(self._path), type=dict[str, tuple[FolderStatus, str]])
        except msgspec.DecodeError:
            self._before = {}
        self._known = self._before if known else {}
        self._now: dict[str, tuple[FolderStatus, str]] = {}

    def status(self, folder: str) -> FolderStatus | None:
        """What the disk says of a folder, asked before it is listed; None where it says nothing."""
        try:
            found = os.stat(folder)
        except OSError:  # listing it will say why
            return None
        return found.st_mtime_ns, found.st_ctime_ns, found.st_ino, found.st_dev

    def names(self, path: str, status: FolderStatus | None) -> list[str] | None:
        """The names in the folder at this path, relative to the catalogue; None where it must be listed."""
        entry = self._known.get(path)
        if entry is None or entry[0] != status:
            return None
        self._now[path] = entry
        return entry[1].split("/") if entry[1] else []

    def note(self, path: str, status: FolderStatus | None, names: Sequence[str]) -> None:
        """Keep the names in a folder, which are neither folders nor links, and valid UTF-8. A folder that has changed
        just now may do so again within a tick of its clock, and gets no entry.
        """
        if sys.platform == "linux" and status is not None:
            if os.major(status[3]) and max(status[:2]) < self._settled:
                self._now[path] = status, "/".join(names)

    def write(self) -> None:
        """Put the entries of this listing in the place of all others. Raises OSError where the disk refuses."""
        if self._now != self._before:
            _write(self._path, msgspec.msgpack.encode(self._now))


def _write(path: Path, body: bytes) -> None:
    files.write_atomically(path, body + hashlib.sha256(body).digest())


def _read(path: Path) -> bytes:
    """What `_write` wrote; nothing where that is not there as it was."""
    try:
        content = files.read_regular(path, _MAX_BYTES)
    except OSError:
        return b""
    body = content[:-32]
    return body if hashlib.sha256(body).digest() == content[-32:] else b""
