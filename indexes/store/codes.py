"""The cache of codes of an index, `codes/cache.sqlite`: codes of photos by model and content, and digests of files.

It belongs to no generation, and queries do not read it. A code is committed when it is made, so an interrupted build
continues with it. A code has a checksum: after a kill or a full disk it is complete or treated as missing. You may
delete the folder at any time; the next build then reads and encodes every photo.
"""

import sqlite3
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from _touch_retrieval.files import remove_folder
from indexes.errors import WriteFailed

NAME = "codes"
_SCHEMA = """
    PRAGMA auto_vacuum = FULL;
    PRAGMA page_size = 16384;
    PRAGMA synchronous = OFF;  -- commits survive a kill, but not a power failure
    CREATE TABLE IF NOT EXISTS codes (
        model TEXT, digest TEXT, code BLOB, checksum INTEGER, PRIMARY KEY (model, digest));
    CREATE TABLE IF NOT EXISTS files (path TEXT PRIMARY KEY, size INTEGER, mtime_ns INTEGER, digest TEXT) WITHOUT ROWID;
    CREATE TEMP TABLE kept (name TEXT PRIMARY KEY) WITHOUT ROWID;
"""


class FileStatus(NamedTuple):
    """Size in bytes and time of the last change of a file; a file with the same values has the same content."""

    size: int
    mtime_ns: int


class CodeCache:
    """Codes, as bytes, by model and content digest; use it under the lock of the index, on one thread.

    A damaged cache is deleted. Errors of the disk raise `WriteFailed`.

    Args:
        index: Folder of the index.
    """

    def __init__(self, index: Path) -> None:
        self.path = index / NAME / "cache.sqlite"
        try:
            self._connection = self._open()
        except sqlite3.DatabaseError:
            remove_folder(self.path.parent)
            self._connection = self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.close()

    def read(self, model: str, digests: Iterable[str]) -> list[bytes]:
        """Return codes that are stored (`known`). Raises `WriteFailed` for a damaged code, which is deleted."""
        codes = []
        for digest in digests:
            code, checksum = self._select(
                "SELECT code, checksum FROM codes WHERE model = ? AND digest = ?", model, digest
            )[0]
            if _checksum(digest, code) != checksum:
                self._write("DELETE FROM codes WHERE model = ? AND digest = ?", [(model, digest)])
                raise WriteFailed(f"{self.path}: the code of {digest[:12]} was damaged and is deleted; build again")
            codes.append(code)
        return codes

    def known(self, model: str) -> set[str]:
        """Return the digests of all stored codes of a model."""
        return {digest for (digest,) in self._select("SELECT digest FROM codes WHERE model = ?", model)}

    def add(self, model: str, codes: Mapping[str, bytes]) -> None:
        """Store codes by digest."""
        rows = [(model, digest, code, _checksum(digest, code)) for digest, code in codes.items()]
        self._write("INSERT OR REPLACE INTO codes VALUES (?, ?, ?, ?)", rows)

    def unchanged(self, files: Mapping[str, FileStatus]) -> dict[str, str]:
        """Return the digests of the files whose size and time are those that were stored, by path."""
        if not files:
            return {}
        stored = self._select("SELECT * FROM files WHERE path BETWEEN ? AND ?", min(files), max(files))
        return {path: digest for path, *status, digest in stored if files.get(path) == tuple(status)}

    def note_files(self, files: Iterable[tuple[str, FileStatus, str]]) -> None:
        """Store path, status and digest of files."""
        rows = [(path, *status, digest) for path, status, digest in files]
        self._write("INSERT OR REPLACE INTO files VALUES (?, ?, ?, ?)", rows)

    def keep(self, models: Iterable[str], digests: Iterable[str], paths: Iterable[str]) -> None:
        """Delete all other codes and files."""
        for place, names in (
            ("codes WHERE model", models),
            ("codes WHERE digest", digests),
            ("files WHERE path", paths),
        ):
            self._write("INSERT OR IGNORE INTO kept VALUES (?)", [(name,) for name in names])
            self._write(f"DELETE FROM {place} NOT IN (SELECT name FROM kept)", [()])  # noqa: S608 - all fixed text
            self._write("DELETE FROM kept", [()])

    def _select(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        try:
            return self._connection.execute(statement, values).fetchall()
        except sqlite3.DatabaseError as error:
            raise WriteFailed(
                f"{self.path}: the cache is damaged ({error}); delete the folder {self.path.parent} and build again"
            ) from error

    def _write(self, statement: str, rows: Sequence[tuple[object, ...]]) -> None:
        try:
            with self._connection:
                self._connection.executemany(statement, rows)
        except sqlite3.Error as error:
            raise WriteFailed(f"{self.path}: writing failed ({error}); build again") from error

    def _open(self) -> sqlite3.Connection:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            connection = sqlite3.connect(self.path)
            connection.executescript(_SCHEMA)
            connection.execute("SELECT count(*) FROM files").fetchone()
        except (OSError, sqlite3.OperationalError) as error:
            raise WriteFailed(f"{self.path}: cannot be opened ({error}); build again") from error
        return connection


def _checksum(digest: str, code: bytes) -> int:
    return zlib.crc32(digest.encode() + code)
