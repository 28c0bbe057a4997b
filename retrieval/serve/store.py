"""What the service keeps, in SQLite: queries with their gel images and answers, what people said of them, trials.

Write-ahead log and `synchronous = FULL`: when a method that writes returns, what it wrote outlives the process and the
machine. One connection, one thread at a time. Once the file was deleted or replaced, each use fails: SQLite would write
into the deleted one.
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
_APPLICATION, _VERSION = 0x746F7563, 1
_TRIM_EVERY = 32
_LOCK_S = 5.0
"""How long a request waits for another that uses the database; longer only while the disk hangs."""
_SCHEMA = """
CREATE TABLE queries (
    id TEXT PRIMARY KEY, time REAL NOT NULL, verdict TEXT NOT NULL, answer TEXT NOT NULL, search TEXT NOT NULL,
    model TEXT NOT NULL, vector BLOB, bytes INTEGER NOT NULL
) STRICT;
CREATE TABLE pictures (
    query TEXT NOT NULL REFERENCES queries ON DELETE CASCADE, grasp INTEGER NOT NULL, finger TEXT NOT NULL,
    data BLOB NOT NULL, PRIMARY KEY (query, grasp, finger)
) STRICT;
CREATE TABLE said (
    query TEXT PRIMARY KEY REFERENCES queries, time REAL NOT NULL, said TEXT NOT NULL, object_id TEXT,
    photo BLOB
) STRICT;
CREATE TABLE runs (
    id TEXT PRIMARY KEY, time REAL NOT NULL, who TEXT NOT NULL, seed INTEGER NOT NULL, count INTEGER NOT NULL,
    recording TEXT NOT NULL
) STRICT;
CREATE TABLE choices (
    run TEXT NOT NULL REFERENCES runs, number INTEGER NOT NULL, choice INTEGER NOT NULL, truth INTEGER NOT NULL,
    model INTEGER NOT NULL, time REAL NOT NULL, PRIMARY KEY (run, number)
) STRICT;
"""
BACKGROUND = 0
"""The number of the grasp that the no-contact frames are kept as."""


@dataclass(frozen=True)
class StoredQuery:
    """A query of the history. said: what a person said of it, one of SAID, and of which object; None before."""

    id: str
    time: float
    verdict: str
    answer: dict[str, Any]
    feedback: str | None
    object_id: str | None


@dataclass(frozen=True)
class TrialRun:
    """A series of trials that one person does."""

    id: str
    time: float
    participant: str
    seed: int
    count: int
    recording: str


@dataclass(frozen=True)
class TrialChoice:
    """What was chosen in a trial, counted from 1: by the person, in truth, and by the model."""

    number: int
    choice: int
    truth: int
    model: int


def new_id() -> str:
    """A name that nobody guesses; later ones sort after earlier ones."""
    return f"{time.time_ns() // 1_000_000:011x}{secrets.token_hex(6)}"


class HistoryStore:
    """The database in a file, made where there is none. Raises BadInput for another file, RetrievalError where the disk
    refuses.
    """

    def __init__(self, path: Path, keep: int, keep_bytes: int) -> None:
        self.path, self._keep, self._keep_bytes = path, keep, keep_bytes
        self._lock, self._since_trim = Lock(), 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            open_regular(path).close()
        except FileNotFoundError:  # SQLite makes it
            pass
        except OSError as error:
            raise BadInput(f"{path} must be the history of a service: {error.strerror}; name another folder") from error
        self._database = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
        try:
            self._prepare()
        except sqlite3.DatabaseError as error:
            self._database.close()
            raise BadInput(f"{path} must be the history of a service: {error}; name another folder") from error
        self._files = self._identity()

    def _prepare(self) -> None:
        feedback = self._database.execute
        feedback("PRAGMA journal_mode = WAL")
        feedback("PRAGMA synchronous = FULL")
        feedback("PRAGMA foreign_keys = ON")
        if (
            feedback("PRAGMA user_version").fetchone()[0] == 0
            and not feedback("SELECT 1 FROM sqlite_master").fetchone()
        ):
            self._database.executescript(
                f"BEGIN IMMEDIATE; {_SCHEMA} PRAGMA application_id = {_APPLICATION};"
                f"PRAGMA user_version = {_VERSION}; COMMIT;"
            )
        found = feedback("PRAGMA application_id").fetchone()[0], feedback("PRAGMA user_version").fetchone()[0]
        if found != (_APPLICATION, _VERSION):
            raise sqlite3.DatabaseError(f"it is of another program or version ({found[1]})")

    def close(self) -> None:
        """Write the log into the file, and close it."""
        with self._locked():
            self._database.close()

    @contextmanager
    def _locked(self) -> Iterator[None]:
        if not self._lock.acquire(timeout=_LOCK_S):
            raise RetrievalError(f"{self.path} does not answer; is its disk full or gone?")
        try:
            yield
        finally:
            self._lock.release()

    def _identity(self) -> list[tuple[int, int] | None]:
        """Device and inode of the database and of its write-ahead log, by their names; None for a missing one."""
        found: list[tuple[int, int] | None] = [None, None]
        for place, path in enumerate((self.path, self.path.with_name(f"{self.path.name}-wal"))):
            with suppress(OSError):
                status = os.stat(path)
                found[place] = status.st_dev, status.st_ino
        return found

    def _require_in_place(self) -> None:
        """Raise RetrievalError where the open files are not those that have their names."""
        if self._identity() != self._files:
            raise RetrievalError(
                f"{self.path} was deleted or replaced while the service ran, so nothing can be stored in it; "
                "start the service again"
            )

    @contextmanager
    def _using(self, what: str) -> Iterator[None]:
        """The database, for one thread. Raises RetrievalError where the disk refuses."""
        with self._locked():
            self._require_in_place()
            try:
                yield
            except sqlite3.IntegrityError:
                raise
            except sqlite3.Error as error:
                raise RetrievalError(f"{self.path} cannot be {what}: {error}") from error

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """A transaction that is on the disk when this ends, or never was."""
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

    def keep(
        self,
        name: str,
        touches: Sequence[Sequence[bytes]],
        background: Sequence[bytes] | None,
        result: QueryResult,
        model: str,
    ) -> None:
        """Keep a query. model: digest of the one whose embeddings the answer carries."""
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
        row = (name, time.time(), result.verdict, json.dumps(result.to_dict()), _searched(words), model, vector, size)
        with self._writing() as database:
            database.execute("INSERT INTO queries VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
            database.executemany("INSERT INTO pictures VALUES (?, ?, ?, ?)", pictures)
            self._since_trim += 1
            if self._since_trim >= _TRIM_EVERY:
                self._since_trim = 0
                self._trim(database)

    def _trim(self, database: sqlite3.Connection) -> None:
        """The oldest of which nothing was said go."""
        database.execute(
            """DELETE FROM queries WHERE id IN (SELECT id FROM (
                SELECT id, ROW_NUMBER() OVER newest AS number, SUM(bytes) OVER newest AS total FROM queries
                WHERE id NOT IN (SELECT query FROM said) WINDOW newest AS (ORDER BY id DESC)
            ) WHERE number > ? OR total > ?)""",
            (self._keep, self._keep_bytes),
        )

    def history(
        self, *, words: Sequence[str] = (), feedback: str | None = None, offset: int = 0, limit: int = 100
    ) -> tuple[int, list[StoredQuery]]:
        """How many queries hold all words and of which this was said ("nothing": no one said anything), and some of
        them, the newest first.
        """
        conditions = ["instr(search, ?) > 0"] * len(words)
        values: list[Any] = [word.casefold() for word in words]
        if feedback == "missing":
            conditions.append("said IS NULL")
        elif feedback is not None:
            conditions.append("said = ?")
            values.append(feedback)
        where = f"FROM queries LEFT JOIN said ON query = id WHERE {' AND '.join(conditions) or '1'}"
        total = self._read(f"SELECT COUNT(*) {where}", values)[0][0]
        found = self._read(f"SELECT {_COLUMNS} {where} ORDER BY id DESC LIMIT ? OFFSET ?", [*values, limit, offset])
        return total, [_stored_query(row) for row in found]

    def names(self) -> list[str]:
        """The ids of all queries, the oldest first."""
        return [name for (name,) in self._read("SELECT id FROM queries ORDER BY id")]

    def query(self, name: str) -> StoredQuery | None:
        """A query by its id."""
        found = self._read(f"SELECT {_COLUMNS} FROM queries LEFT JOIN said ON query = id WHERE id = ?", [name])  # noqa: S608
        return _stored_query(found[0]) if found else None

    def picture(self, name: str, grasp: int, finger: str) -> bytes | None:
        """A gel image as it was sent; grasp: from 1, BACKGROUND for a no-contact frame."""
        values = (name, grasp, finger)
        found = self._read("SELECT data FROM pictures WHERE query = ? AND grasp = ? AND finger = ?", values)
        return found[0][0] if found else None

    def pictures(self, name: str) -> dict[tuple[int, str], bytes]:
        """All gel images of a query by grasp and finger."""
        found = self._read("SELECT grasp, finger, data FROM pictures WHERE query = ? ORDER BY grasp, finger", [name])
        return {(grasp, finger): data for grasp, finger, data in found}

    def vectors(self, model: str) -> tuple[list[str], NDArray[np.float32]]:
        """The queries that this model encoded, and their unit embeddings (Q, embedding_dim)."""
        found = self._read("SELECT id, vector FROM queries WHERE model = ? AND vector IS NOT NULL", [model])
        vectors = np.array([np.frombuffer(vector, "<f4") for _, vector in found], dtype=np.float32)
        return [name for name, _ in found], vectors

    # What people said -----------------------------------------------------------------------------------------

    def add_feedback(self, name: str, feedback: str, object_id: str | None, photo: bytes | None) -> bool:
        """Keep what was said of a query; False where the same was said before. Raises BadInput where something else
        was, and KeyError where there is no such query, or no more.
        """
        before = self._read("SELECT said, object_id FROM said WHERE query = ?", [name])
        if before:
            if before[0] == (feedback, object_id):
                return False
            raise BadInput(f"of this query was said already: {before[0][0]}, {before[0][1] or 'no object'}")
        try:
            with self._writing() as database:
                database.execute(
                    "INSERT INTO said VALUES (?, ?, ?, ?, ?)", (name, time.time(), feedback, object_id, photo)
                )
                more = _searched([feedback, object_id or ""])
                database.execute("UPDATE queries SET search = search || ? WHERE id = ?", (more, name))
        except sqlite3.IntegrityError:  # between the two steps the query went, or something was said of it
            if self.query(name) is None:
                raise KeyError(name) from None
            return self.add_feedback(name, feedback, object_id, photo)
        return True

    def recordable(self) -> list[tuple[str, str]]:
        """Queries whose object is known and has a photo, with the object; in the order in which it was said."""
        found = self._read("SELECT query, object_id FROM said WHERE photo IS NOT NULL ORDER BY time, query")
        return [(name, object_id) for name, object_id in found]

    def photo(self, name: str) -> bytes | None:
        """The photo of the object that was said."""
        found = self._read("SELECT photo FROM said WHERE query = ?", [name])
        return found[0][0] if found else None

    # Trials -------------------------------------------------------------------------------------------------

    def add_run(self, run: TrialRun) -> None:
        """Keep a new series of trials."""
        with self._writing() as database:
            values = (run.id, run.time, run.participant, run.seed, run.count, run.recording)
            database.execute("INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?)", values)

    def runs(self, recording: str) -> list[TrialRun]:
        """All series of a recording's objects, the newest first."""
        return [
            TrialRun(*row) for row in self._read("SELECT * FROM runs WHERE recording = ? ORDER BY id DESC", [recording])
        ]

    def choose(self, run: str, choice: TrialChoice) -> bool:
        """Keep what was chosen; False where something was chosen before."""
        try:
            with self._writing() as database:
                values = (run, choice.number, choice.choice, choice.truth, choice.model, time.time())
                database.execute("INSERT INTO choices VALUES (?, ?, ?, ?, ?, ?)", values)
        except sqlite3.IntegrityError:
            return False
        return True

    def choices(self, run: str) -> list[TrialChoice]:
        """What was chosen so far, by number."""
        found = self._read("SELECT number, choice, truth, model FROM choices WHERE run = ? ORDER BY number", [run])
        return [TrialChoice(*row) for row in found]


_COLUMNS = "id, queries.time, verdict, answer, said, object_id"


def _stored_query(row: tuple[Any, ...]) -> StoredQuery:
    name, when, verdict, answer, feedback, object_id = row
    return StoredQuery(name, when, verdict, replace_surrogates(json.loads(answer)), feedback, object_id)


def _searched(words: Sequence[str]) -> str:
    return "".join(f"\n{word.casefold()}" for word in words)
