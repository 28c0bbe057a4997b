"""What a build has embedded until it was cut off, kept for the next one to take up: `unfinished.sqlite`.

A record stands under the digest of the content and under a key of what makes the arrays and of their layout, so that
nothing is ever taken from another model's build. It is committed at once, with a checksum: whatever a kill or a full
disk leaves, a record is whole or counts as absent. The file belongs to no generation and no query opens it. It may be
deleted at any time, and is when a generation has been written.
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
    """Records by digest, in the folder `index`; use it under the index's lock. Threads may share it.

    layouts: name of an array -> dtype and shape of one record's, as in `indexes.store.tables`.
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
                whole = self._open().execute("PRAGMA quick_check").fetchall() == [("ok",)]
            except sqlite3.Error:
                whole = False
            if not whole:
                self.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._connection is not None:
            self._connection.close()

    def find(self, digests: Iterable[str]) -> dict[str, Any]:
        """Of these digests, those of which an earlier build left a whole record: {digest: record}, which gives its
        arrays by their names.
        """
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
        """Write records of these digests: arrays (n, ...) by name. Those that are not finite are left out.

        Raises `WriteFailed` where the disk refuses.
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
            raise WriteFailed(f"{self.path}: the disk refused ({error}); build again") from error

    def clear(self) -> None:
        """Delete what all unfinished builds left: a generation holds it now. What cannot be deleted stays."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        for path in (self.path, self.path.with_name(f"{NAME}-journal")):
            with suppress(OSError):
                path.unlink()

    def _open(self) -> sqlite3.Connection:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._connection = sqlite3.connect(self.path, check_same_thread=False)
        self._connection.execute("PRAGMA synchronous = OFF")  # a commit outlives the process, though not the power
        self._connection.execute(_TABLE)
        self._connection.execute("PRAGMA user_version = 1")  # fails where it cannot be written to
        return self._connection


def _checksum(digest: str, arrays: bytes) -> int:
    return zlib.crc32(digest.encode() + arrays)
