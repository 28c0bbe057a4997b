"""The stat cache of photos' files and folders. Files and folders with the same stat are not read or listed again.

    files.stat      for each file: keys of its row's id and of its content digest, size, times and inode
    folders.stat    for each folder without folders and links in it: times, inode, device, and the names in it

Each entry states that a file with this stat has this content, whatever generation is current. The files belong to no
generation and may be deleted at any time; the next build then reads everything. It also does if the SHA-256 at the
end of a file shows that it was altered or truncated.
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
"""Time without a change that an entry needs: the coarsest clock of a common disk (FAT) ticks every two seconds."""
STATUS = ("bytes", "mtime_ns", "ctime_ns", "inode")
"""Compared values of a file's stat, each modulo 2^64."""
RECORD = np.dtype([("id", "S16"), ("digest", "S16"), ("status", "<u8", (len(STATUS),))])
_MAX_BYTES = 2**33

Keys: TypeAlias = NDArray[np.bytes_]
Statuses: TypeAlias = NDArray[np.uint64]
FolderStatus: TypeAlias = tuple[int, int, int, int]


class StatRecords:
    """Stat records of the files, in the folder of an index; use it under the lock of the index.

    Attributes:
        records: Array (N,) of `RECORD`.
    """

    def __init__(self, index: Path) -> None:
        self._path = index / FILES
        body = _read(self._path)
        self.records = np.frombuffer(body, RECORD, count=len(body) // RECORD.itemsize)

    def digests(self, ids: Keys, statuses: Statuses) -> Keys:
        """Return the key of the content digest of each file.

        Args:
            ids: Keys (N,) of the rows' ids.
            statuses: Stat values (N, 4) of the files.

        Returns:
            Keys (N,); b"" if the stat changed or is unknown.
        """
        found = np.zeros(len(ids), "S16")
        if len(self.records):
            number = KeyIndex(np.ascontiguousarray(self.records["id"])).find(ids)
            same = (number >= 0) & (self.records["status"][number] == statuses).all(axis=1)
            found[same] = self.records["digest"][number[same]]
        return found

    def write(self, ids: Keys, digests: Keys, statuses: Statuses) -> None:
        """Replace all records.

        Args:
            ids: Keys (N,) of the rows' ids.
            digests: Keys (N,) of the content digests.
            statuses: Stat values (N, 4) of the files.

        Raises:
            OSError: The disk refuses.
        """
        before, self.records = self.records, np.zeros(len(ids), RECORD)
        self.records["id"], self.records["digest"], self.records["status"] = ids, digests, statuses
        if (body := self.records.tobytes()) != before.tobytes():
            _write(self._path, body)


class FolderCache:
    """Stat entries of folders, in the folder of an index, and the new entries of a listing.

    Create it before the listing begins. On local disks a folder's times change with the names in it. Folders on no
    block device, such as network folders, get no entry.

    Args:
        index: Folder of the index.
        known: Use the stored entries; otherwise every folder is listed.
    """

    def __init__(self, index: Path, known: bool = True) -> None:
        self._path, self._max_time_ns = index / FOLDERS, time.time_ns() - MIN_AGE_NS
        try:
            self._before = msgspec.msgpack.decode(_read(self._path), type=dict[str, tuple[FolderStatus, str]])
        except msgspec.DecodeError:
            self._before = {}
        self._known = self._before if known else {}
        self._now: dict[str, tuple[FolderStatus, str]] = {}

    def status(self, folder: str) -> FolderStatus | None:
        """Return the stat of a folder, to be read before it is listed; None if it cannot be read."""
        try:
            found = os.stat(folder)
        except OSError:  # listing it reports the error
            return None
        return found.st_mtime_ns, found.st_ctime_ns, found.st_ino, found.st_dev

    def names(self, path: str, status: FolderStatus | None) -> list[str] | None:
        """Return the stored names in a folder; None if it must be listed.

        Args:
            path: Path of the folder, relative to the catalogue.
            status: Its stat.
        """
        entry = self._known.get(path)
        if entry is None or entry[0] != status:
            return None
        self._now[path] = entry
        return entry[1].split("/") if entry[1] else []

    def note(self, path: str, status: FolderStatus | None, names: Sequence[str]) -> None:
        """Store the names in a folder. A folder that has just changed gets no entry: it may change again in one tick.

        Args:
            path: Path of the folder, relative to the catalogue.
            status: Its stat.
            names: Its names, valid UTF-8, of neither folders nor links.
        """
        if sys.platform == "linux" and status is not None:
            if os.major(status[3]) and max(status[:2]) < self._max_time_ns:
                self._now[path] = status, "/".join(names)

    def write(self) -> None:
        """Replace all entries with those of this listing. Raises OSError if the disk refuses."""
        if self._now != self._before:
            _write(self._path, msgspec.msgpack.encode(self._now))


def _write(path: Path, body: bytes) -> None:
    files.write_atomically(path, body + hashlib.sha256(body).digest())


def _read(path: Path) -> bytes:
    """Return the content that `_write` wrote; empty if the file is missing or was altered."""
    try:
        content = files.read_regular(path, _MAX_BYTES)
    except OSError:
        return b""
    body = content[:-32]
    return body if hashlib.sha256(body).digest() == content[-32:] else b""
