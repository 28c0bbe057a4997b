"""SQLite database of the service: queries with their gel images and answers, feedback, trials.

The database uses a write-ahead log and `synchronous = FULL`: data is on the disk when a writing method returns. One
connection serves one thread at a time. After the file is deleted or replaced, each use fails; SQLite itself would write
into the deleted file.
"""

import json
import os
import secrets
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from string import ascii_lowercase
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import open_regular
from retrieval.data.text import replace_surrogates
from retrieval.errors import BadInput, RetrievalError
from retrieval.search.query.answer import QueryResult

RIGHT, OBJECT, NONE = "right", "object", "none"
FEEDBACK_VALUES = (RIGHT, OBJECT, NONE)
_APPLICATION, _VERSION = 0x746F7563, 2
_TRIM_EVERY = 32
_LOCK_S = 5.0
"""Maximum time that a request waits for the database; only a hanging disk takes longer."""
_SCHEMA = """
CREATE TABLE queries (
    id TEXT PRIMARY KEY, time REAL NOT NULL, verdict TEXT NOT NULL, answer TEXT NOT NULL, search TEXT NOT NULL,
    model TEXT NOT NULL, vector BLOB, bytes INTEGER NOT NULL
) STRICT;
CREATE TABLE pictures (
    query TEXT NOT NULL REFERENCES queries ON DELETE CASCADE, grasp INTEGER NOT NULL, finger TEXT NOT NULL,
    data BLOB NOT NULL, PRIMARY KEY (query, grasp, finger)
) STRICT;
CREATE TABLE feedback (
    query TEXT PRIMARY KEY REFERENCES queries, time REAL NOT NULL, feedback TEXT NOT NULL, object_id TEXT,
    photo BLOB
) STRICT;
CREATE TABLE runs (
    id TEXT PRIMARY KEY, time REAL NOT NULL, participant TEXT NOT NULL, seed INTEGER NOT NULL, count INTEGER NOT NULL,
    recording TEXT NOT NULL
) STRICT;
CREATE TABLE choices (
    run TEXT NOT NULL REFERENCES runs, number INTEGER NOT NULL, choice INTEGER NOT NULL, truth INTEGER NOT NULL,
    model INTEGER NOT NULL, time REAL NOT NULL, PRIMARY KEY (run, number)
) STRICT;
"""
BACKGROUND = 0
"""Grasp number under which the no-contact frames are stored."""


@dataclass(frozen=True)
class StoredQuery:
    """A query of the history; times are Unix times in seconds.

    feedback: one of `FEEDBACK_VALUES`; None if there is no feedback. object_id: the object that the feedback names.
    """

    id: str
    time: float
    verdict: str
    answer: dict[str, Any]
    feedback: str | None
    object_id: str | None


@dataclass(frozen=True)
class TrialRun:
    """A series of trials of one person."""

    id: str
    time: float
    participant: str
    seed: int
    count: int
    recording: str


@dataclass(frozen=True)
class TrialChoice:
    """Result of one trial, as photo numbers from 1: the person's choice, the right photo, and the model's choice."""

    number: int
    choice: int
    truth: int
    model: int


def new_id() -> str:
    """Return an unguessable id; later ids sort after earlier ones."""
    return f"{time.time_ns() // 1_000_000:011x}{secrets.token_hex(6)}"


class HistoryStore:
    """The database in one file, which is created if it is missing.

    Args:
        path: File of the database.
        max_queries: Maximum number of stored queries without feedback.
        max_bytes: Maximum total size of the gel images of queries without feedback.

    Raises:
        BadInput: The file is not a database of this version.
        RetrievalError: The disk fails.
    """

    def __init__(self, path: Path, max_queries: int, max_bytes: int) -> None:
        self.path, self._max_queries, self._max_bytes = path, max_queries, max_bytes
        self._lock, self._since_trim = Lock(), 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            open_regular(path).close()
        except FileNotFoundError:  # SQLite creates it
            pass
        except OSError as error:
            raise BadInput(f"{path} must be the history of a service: {error.strerror}. Use another folder.") from error
        self._database = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
        try:
            self._prepare()
        except sqlite3.DatabaseError as error:
            self._database.close()
            raise BadInput(f"{path} must be the history of a service: {error}. Use another folder.") from error
        self._files = self._identity()

    def _prepare(self) -> None:
        execute = self._database.execute
        execute("PRAGMA journal_mode = WAL")
        execute("PRAGMA synchronous = FULL")
        execute("PRAGMA foreign_keys = ON")
        if execute("PRAGMA user_version").fetchone()[0] == 0 and not execute("SELECT 1 FROM sqlite_master").fetchone():
            self._database.executescript(
                f"BEGIN IMMEDIATE; {_SCHEMA} PRAGMA application_id = {_APPLICATION};"
                f"PRAGMA user_version = {_VERSION}; COMMIT;"
            )
        found = execute("PRAGMA application_id").fetchone()[0], execute("PRAGMA user_version").fetchone()[0]
        if found != (_APPLICATION, _VERSION):
            whose = "another program" if found[0] != _APPLICATION else f"version {found[1]}, not {_VERSION}"
            raise sqlite3.DatabaseError(f"it is a database of {whose}")

    def close(self) -> None:
        """Write the log into the file, and close the file."""
        with self._locked():
            self._database.close()

    @contextmanager
    def _locked(self) -> Iterator[None]:
        if not self._lock.acquire(timeout=_LOCK_S):
            raise RetrievalError(
                f"{self.path} does not respond within {_LOCK_S:g} s. Check whether its disk is full or gone."
            )
        try:
            yield
        finally:
            self._lock.release()

    def _identity(self) -> list[tuple[int, int] | None]:
        """Return device and inode of the database file and of its write-ahead log; None for a missing file."""
        found: list[tuple[int, int] | None] = [None, None]
        for place, path in enumerate((self.path, self.path.with_name(f"{self.path.name}-wal"))):
            with suppress(OSError):
                status = os.stat(path)
                found[place] = status.st_dev, status.st_ino
        return found

    def _require_in_place(self) -> None:
        """Raise RetrievalError if the open files were deleted or replaced."""
        if self._identity() != self._files:
            raise RetrievalError(
                f"{self.path} was deleted or replaced while the service ran, so nothing can be stored. "
                "Start the service again."
            )

    @contextmanager
    def _using(self, action: str) -> Iterator[None]:
        """Lock the database for one thread; raises RetrievalError if the disk fails. action: "read" or "written"."""
        with self._locked():
            self._require_in_place()
            try:
                yield
            except sqlite3.IntegrityError:
                raise
            except sqlite3.Error as error:
                raise RetrievalError(f"{self.path} cannot be {action}: {error}") from error

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """Run a transaction, which is on the disk at the end or has no effect."""
        with self._using("written"):
            try:
                self._database.execute("BEGIN IMMEDIATE")
                yield self._database
                self._database.execute("COMMIT")
            except BaseException:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")
                raise
            self._require_in_place()

    def _read(self, text: str, values: Sequence[Any] = ()) -> list[Any]:
        with self._using("read"):
            return self._database.execute(text, values).fetchall()

    # Queries ------------------------------------------------------------------------------------------------

    def add_query(
        self,
        name: str,
        touches: Sequence[Sequence[bytes]],
        background: Sequence[bytes] | None,
        result: QueryResult,
        model: str,
    ) -> None:
        """Store a query with its image files and its answer; `model` is the digest of the checkpoint."""
        pictures = [
            (name, number, ascii_lowercase[finger], data)
            for number, images in enumerate([background or (), *touches])
            for finger, data in enumerate(images)
        ]
        words = [result.verdict, *(match.object_id for match in result.results[:1])]
        vector = None
        if result.embeddings is not None and len(result.embeddings):
            mean = result.embeddings.mean(axis=0)
            vector = (mean / max(float(np.linalg.norm(mean)), 1e-12)).astype("<f4").tobytes()
        size = sum(len(data) for *_, data in pictures)
        row = (
            name,
            time.time(),
            result.verdict,
            json.dumps(result.to_dict()),
            _search_text(words),
            model,
            vector,
            size,
        )
        with self._writing() as database:
            database.execute("INSERT INTO queries VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
            database.executemany("INSERT INTO pictures VALUES (?, ?, ?, ?)", pictures)
            self._since_trim += 1
            if self._since_trim >= _TRIM_EVERY:
                self._since_trim = 0
                self._trim(database)

    def _trim(self, database: sqlite3.Connection) -> None:
        """Delete the oldest queries without feedback beyond the limits."""
        database.execute(
            """DELETE FROM queries WHERE id IN (SELECT id FROM (
                SELECT id, ROW_NUMBER() OVER newest AS number, SUM(bytes) OVER newest AS total FROM queries
                WHERE id NOT IN (SELECT query FROM feedback) WINDOW newest AS (ORDER BY id DESC)
            ) WHERE number > ? OR total > ?)""",
            (self._max_queries, self._max_bytes),
        )

    def history(
        self, *, words: Sequence[str] = (), feedback: str | None = None, offset: int = 0, limit: int = 100
    ) -> tuple[int, list[StoredQuery]]:
        """Return the number of matching queries, and one page of them, the newest first.

        Args:
            words: Words that must all occur in the verdict, the object or the feedback.
            feedback: One of `FEEDBACK_VALUES`, "missing" for queries without feedback, or None for all.
            offset: Number of matches to skip.
            limit: Maximum number of queries to return.

        Returns:
            The number of all matches, and the queries of the page.
        """
        conditions = ["instr(search, ?) > 0"] * len(words)
        values: list[Any] = [word.casefold() for word in words]
        if feedback == "missing":
            conditions.append("feedback IS NULL")
        elif feedback is not None:
            conditions.append("feedback = ?")
            values.append(feedback)
        where = f"FROM queries LEFT JOIN feedback ON query = id WHERE {' AND '.join(conditions) or '1'}"
        total = self._read(f"SELECT COUNT(*) {where}", values)[0][0]
        found = self._read(f"SELECT {_COLUMNS} {where} ORDER BY id DESC LIMIT ? OFFSET ?", [*values, limit, offset])
        return total, [_stored_query(row) for row in found]

    def names(self) -> list[str]:
        """Return the ids of all queries, the oldest first."""
        return [name for (name,) in self._read("SELECT id FROM queries ORDER BY id")]

    def query(self, name: str) -> StoredQuery | None:
        """Return a query by its id, or None if it is missing."""
        found = self._read(f"SELECT {_COLUMNS} FROM queries LEFT JOIN feedback ON query = id WHERE id = ?", [name])  # noqa: S608
        return _stored_query(found[0]) if found else None

    def picture(self, name: str, grasp: int, finger: str) -> bytes | None:
        """Return the file of a gel image, or None. grasp: counted from 1; BACKGROUND for a no-contact frame."""
        values = (name, grasp, finger)
        found = self._read("SELECT data FROM pictures WHERE query = ? AND grasp = ? AND finger = ?", values)
        return found[0][0] if found else None

    def pictures(self, name: str) -> dict[tuple[int, str], bytes]:
        """Return the files of all gel images of a query, by grasp and finger."""
        found = self._read("SELECT grasp, finger, data FROM pictures WHERE query = ? ORDER BY grasp, finger", [name])
        return {(grasp, finger): data for grasp, finger, data in found}

    def vectors(self, model: str) -> tuple[list[str], NDArray[np.float32]]:
        """Return the ids of the queries that this model encoded, and their unit embeddings (Q, embedding_dim)."""
        found = self._read("SELECT id, vector FROM queries WHERE model = ? AND vector IS NOT NULL", [model])
        vectors = np.array([np.frombuffer(vector, "<f4") for _, vector in found], dtype=np.float32)
        return [name for name, _ in found], vectors

    # Feedback -------------------------------------------------------------------------------------------------

    def add_feedback(self, name: str, feedback: str, object_id: str | None, photo: bytes | None) -> bool:
        """Store the feedback on a query, and the file of the object's photo.

        Feedback without a photo is stored, but its grasps are not added to the recording.

        Returns:
            True if the feedback is new, False if the same feedback is stored already.

        Raises:
            BadInput: Different feedback is stored already.
            KeyError: There is no such query.
        """
        before = self._read("SELECT feedback, object_id FROM feedback WHERE query = ?", [name])
        if before:
            if before[0] == (feedback, object_id):
                return False
            stored = f"{before[0][0]}, {before[0][1] or 'no object'}"
            raise BadInput(f"This query has different feedback already: {stored}.")
        try:
            with self._writing() as database:
                database.execute(
                    "INSERT INTO feedback VALUES (?, ?, ?, ?, ?)", (name, time.time(), feedback, object_id, photo)
                )
                more = _search_text([feedback, object_id or ""])
                database.execute("UPDATE queries SET search = search || ? WHERE id = ?", (more, name))
        except sqlite3.IntegrityError:  # the query was deleted, or got feedback, in the meantime
            if self.query(name) is None:
                raise KeyError(name) from None
            return self.add_feedback(name, feedback, object_id, photo)
        return True

    def recordable(self) -> list[tuple[str, str]]:
        """Return query and object of all feedback whose object has a photo, in the order of the feedback."""
        found = self._read("SELECT query, object_id FROM feedback WHERE photo IS NOT NULL ORDER BY time, query")
        return [(name, object_id) for name, object_id in found]

    def photo(self, name: str) -> bytes | None:
        """Return the photo of the object that the feedback names, or None."""
        found = self._read("SELECT photo FROM feedback WHERE query = ?", [name])
        return found[0][0] if found else None

    # Trials -------------------------------------------------------------------------------------------------

    def add_run(self, run: TrialRun) -> None:
        """Store a new series of trials."""
        with self._writing() as database:
            values = (run.id, run.time, run.participant, run.seed, run.count, run.recording)
            database.execute("INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?)", values)

    def runs(self, recording: str) -> list[TrialRun]:
        """Return all series of a recording, the newest first."""
        return [
            TrialRun(*row) for row in self._read("SELECT * FROM runs WHERE recording = ? ORDER BY id DESC", [recording])
        ]

    def choose(self, run: str, choice: TrialChoice) -> bool:
        """Store the result of a trial; return False if the trial has a result already."""
        try:
            with self._writing() as database:
                values = (run, choice.number, choice.choice, choice.truth, choice.model, time.time())
                database.execute("INSERT INTO choices VALUES (?, ?, ?, ?, ?, ?)", values)
        except sqlite3.IntegrityError:
            return False
        return True

    def choices(self, run: str) -> list[TrialChoice]:
        """Return the results of a series, by trial number."""
        found = self._read("SELECT number, choice, truth, model FROM choices WHERE run = ? ORDER BY number", [run])
        return [TrialChoice(*row) for row in found]


_COLUMNS = "id, queries.time, verdict, answer, feedback, object_id"


def _stored_query(row: tuple[Any, ...]) -> StoredQuery:
    name, unix_time, verdict, answer, feedback, object_id = row
    return StoredQuery(name, unix_time, verdict, replace_surrogates(json.loads(answer)), feedback, object_id)


def _search_text(words: Sequence[str]) -> str:
    return "".join(f"\n{word.casefold()}" for word in words)
