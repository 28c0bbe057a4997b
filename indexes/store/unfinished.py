"""Codes of an interrupted build, stored for the next build: `unfinished.sqlite`.

The key of a record is the digest of the content, with a digest of the fingerprint and the array layout, so codes of
another model are never reused. Records are committed immediately, with a checksum: after a kill or a full disk, a
record is complete or treated as missing. The file belongs to no generation, and queries do not read it. It may be
deleted at any time; a build deletes it after writing a generation.
"""

import hashlib
import json
import sqlite3
import threading
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from indexes.errors import WriteFailed
from indexes.store.tables import Layouts

NAME = "unfinished.sqlite"
_TABLE = """CREATE TABLE IF NOT EXISTS records (
    maker TEXT, digest TEXT, arrays BLOB, checksum INTEGER, PRIMARY KEY (maker, digest)) WITHOUT ROWID"""


class UnfinishedBuild:
    """Records by content digest; use it under the lock of the index. Threads may share it.

    Args:
        index: Folder of the index.
        fingerprint: Fingerprint of the model.
        layouts: Name of each array to its dtype and shape in one record (`indexes.store.tables`).
    """

    def __init__(self, index: Path, fingerprint: Mapping[str, str], layouts: Layouts) -> None:
        self.path = index / NAME
        self._record = np.dtype([(name, *how) for name, how in layouts.items()])
        maker = {"fingerprint": dict(fingerprint), "record": str(self._record)}
        self._maker = hashlib.sha256(json.dumps(maker, sort_keys=True).encode()).hexdigest()
        self._lock = threading.Lock()
        self._connection: sqlite3.Connection | None = None
        if self.path.exists():
            try:
                intact = self._open().execute("PRAGMA quick_check").fetchall() == [("ok",)]
            except sqlite3.Error:
                intact = False
            if not intact:
                self.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._connection is not None:
            self._connection.close()

    def find(self, digests: Iterable[str]) -> dict[str, Any]:
        """Return {digest: record} for those digests that have a complete record; a record has arrays by name."""
        if self._connection is None:
            return {}
        found = {}
        for digest in digests:
            with self._lock:
                row = self._connection.execute(
                    "SELECT arrays, checksum FROM records WHERE maker = ? AND digest = ?", (self._maker, digest)
                ).fetchone()
            if row is not None and _checksum(digest, row[0]) == row[1]:
                found[digest] = np.frombuffer(row[0], self._record)[0]
        return found

    def add(self, digests: Sequence[str], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write records; skip those with numbers that are not finite.

        Args:
            digests: The n content digests.
            arrays: Name to array (n, ...).

        Raises:
            WriteFailed: The disk refuses.
        """
        records, finite = np.zeros(len(digests), self._record), np.ones(len(digests), bool)
        for name in self._record.names or ():
            records[name] = arrays[name]
            finite &= np.isfinite(arrays[name]).reshape(len(digests), -1).all(axis=1)
        rows = [
            (self._maker, digest, record.tobytes(), _checksum(digest, record.tobytes()))
            for digest, record, good in zip(digests, records, finite, strict=True)
            if good
        ]
        try:
            with self._lock, self._connection or self._open() as connection:
                connection.executemany("INSERT OR REPLACE INTO records VALUES (?, ?, ?, ?)", rows)
        except (OSError, sqlite3.Error) as error:
            raise WriteFailed(f"{self.path}: writing failed ({error}); build again") from error

    def clear(self) -> None:
        """Delete all records, after a generation contains them. Files that cannot be deleted stay."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        for path in (self.path, self.path.with_name(f"{NAME}-journal")):
            with suppress(OSError):
                path.unlink()

    def _open(self) -> sqlite3.Connection:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._connection = sqlite3.connect(self.path, check_same_thread=False)
        self._connection.execute("PRAGMA synchronous = OFF")  # commits survive a kill, but not a power failure
        self._connection.execute(_TABLE)
        self._connection.execute("PRAGMA user_version = 1")  # fails if the file is not writable
        return self._connection


def _checksum(digest: str, arrays: bytes) -> int:
    return zlib.crc32(digest.encode() + arrays)
