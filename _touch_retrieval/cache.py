"""The cache of results that take long to compute: features, predictions, codes of photos, parts of a report.

It is content-addressed: a key is a digest of everything that determines the result (`cache_key`), so an entry is never
out of date, and it is bytes; the user encodes and decodes them. Each `add` is committed at once, so an interrupted job
finds its finished parts when the same command runs again. An entry has a checksum: after a kill or a full disk it is
complete or missing. The file may be deleted at any time.
"""

import errno
import hashlib
import json
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

_SCHEMA = """
    PRAGMA auto_vacuum = FULL;
    PRAGMA page_size = 16384;
    PRAGMA synchronous = OFF;  -- commits survive a kill, but not a power failure
    CREATE TABLE IF NOT EXISTS entries (key TEXT PRIMARY KEY, content BLOB, checksum INTEGER);
"""


def cache_key(group: str, *inputs: Any) -> str:
    """Return a key, `group/digest`, which is equal for equal inputs.

    Args:
        group: Kind of the content, such as "features".
        *inputs: All that determines the content, in JSON types: digests, settings, and a number that rises when the
            code gives other results.

    >>> cache_key("features", "8f0c", {"seed": 0}) == cache_key("features", "8f0c", {"seed": 1})
    False
    """
    text = json.dumps(inputs, sort_keys=True, allow_nan=False)
    return f"{group}/{hashlib.sha256(text.encode()).hexdigest()}"


class Cache:
    """Bytes by key in one SQLite file; use it as a context manager, on one thread.

    Several processes may have it open. A file that is no cache is replaced. An error of the disk is an OSError with the
    path and what to do.

    Args:
        path: The file, such as out/cache.sqlite; it is created with its folder.

    >>> from pathlib import Path
    >>> with Cache(Path("cache.sqlite")) as cache:
    ...     cache.add({cache_key("sum", 2, 3): b"5"})
    ...     cache.get(cache_key("sum", 2, 3)), cache.get(cache_key("sum", 2, 4))
    (b'5', None)
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        with self._disk_errors():
            try:
                self._connection = self._open()
            except sqlite3.OperationalError:  # cannot be opened, or the disk is full
                raise
            except sqlite3.DatabaseError:
                path.unlink()
                self._connection = self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._connection.close()

    def get(self, key: str) -> bytes | None:
        """Return an entry; None if it is missing or damaged."""
        return self.get_all([key]).get(key)

    def get_all(self, keys: Sequence[str]) -> dict[str, bytes]:
        """Return those of some entries that are neither missing nor damaged. Damaged ones are deleted."""
        select = "SELECT key, content, checksum FROM entries WHERE key IN (SELECT value FROM json_each(?))"
        with self._disk_errors():
            rows = self._connection.execute(select, (json.dumps(keys),)).fetchall()
            damaged = [(key,) for key, content, checksum in rows if _checksum(key, content) != checksum]
            if damaged:
                with self._connection:
                    self._connection.executemany("DELETE FROM entries WHERE key = ?", damaged)
        return {key: content for key, content, _ in rows if (key,) not in damaged}

    def add(self, entries: Mapping[str, bytes]) -> None:
        """Store entries by key in one commit."""
        rows = [(key, content, _checksum(key, content)) for key, content in entries.items()]
        with self._disk_errors(), self._connection:
            self._connection.executemany("INSERT OR REPLACE INTO entries VALUES (?, ?, ?)", rows)

    def keys(self, group: str) -> set[str]:
        """Return the keys of a group."""
        with self._disk_errors():
            rows = self._connection.execute(
                "SELECT key FROM entries WHERE key BETWEEN ? AND ?", (f"{group}/", f"{group}0")
            )
            return {key for (key,) in rows}

    def keep(self, keys: Iterable[str]) -> None:
        """Delete all other entries, and give their room back to the disk."""
        delete = "DELETE FROM entries WHERE key NOT IN (SELECT value FROM json_each(?))"
        with self._disk_errors(), self._connection:
            self._connection.execute(delete, (json.dumps(list(keys)),))

    def _open(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self.path, timeout=60.0)  # the wait for another process that writes to it
        try:
            connection.executescript(_SCHEMA)
            connection.execute("SELECT key, content, checksum FROM entries LIMIT 1").fetchone()
        except BaseException:
            connection.close()
            raise
        return connection

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            what = f"the cache cannot be read or written ({error}); unless the disk is full, delete this file"
            raise OSError(errno.EIO, f"{what}, and run the same command again", str(self.path)) from error


def _checksum(key: str, content: object) -> int | None:
    return zlib.crc32(key.encode() + content) if isinstance(content, bytes) else None
