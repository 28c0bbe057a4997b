"""History of the service: a SQLite database, and a recording of the feedback.

The database is authoritative: queries with their gel images and answers, and feedback. It uses a write-ahead log.
Feedback is on the disk when the method returns; the newest queries may be lost in a power failure. One connection
serves one thread at a time. The recording, which `retrieve train` and `retrieve check` read, is updated after each
feedback and at the start. This layer does not import `robot`: the command passes the recording's writer.
"""

import asyncio
import json
import logging
import secrets
import sqlite3
import time
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from string import ascii_lowercase
from threading import Lock
from typing import Any, Protocol

import numpy as np

from retrieval.data.catalogue import HISTORY
from retrieval.data.images import decode_rgb, encode_image
from retrieval.data.text import replace_surrogates
from retrieval.errors import BadInput, RetrievalError
from retrieval.model.gel_check import CONTACT
from retrieval.search.answer import QueryResult
from retrieval.serve.uploads import RequestPictures

log = logging.getLogger(__name__)
IMAGE_TYPES = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}
"""First bytes of the image formats that every browser shows, and a recording may contain -> media type."""
RIGHT, OBJECT, NONE = "right", "object", "none"
"""Values of the feedback: the answer is right, it is another object, the catalogue lacks the object."""
ADVICE = "Give another folder with --history, or store nothing with --no-history."
_VERSION = 3
_SCHEMA = f"""
BEGIN;
CREATE TABLE IF NOT EXISTS queries (
    id TEXT PRIMARY KEY, time REAL NOT NULL, verdict TEXT NOT NULL, best TEXT NOT NULL, answer TEXT NOT NULL
) STRICT;
CREATE TABLE IF NOT EXISTS pictures (
    query TEXT NOT NULL REFERENCES queries ON DELETE CASCADE, grasp INTEGER NOT NULL, finger TEXT NOT NULL,
    data BLOB NOT NULL, PRIMARY KEY (query, grasp, finger)
) STRICT;
CREATE TABLE IF NOT EXISTS feedback (
    query TEXT PRIMARY KEY REFERENCES queries, time REAL NOT NULL, feedback TEXT NOT NULL, object_id TEXT,
    photo BLOB
) STRICT;
PRAGMA user_version = {_VERSION};
COMMIT;
"""
BACKGROUND = 0
"""Grasp number under which the no-contact frames are stored."""


@dataclass(frozen=True)
class StoredQuery:
    """A query of the history; times are Unix times in seconds.

    feedback: `RIGHT`, `OBJECT` or `NONE`; None if there is no feedback. object_id: the object that the feedback names.
    """

    id: str
    time: float
    verdict: str
    answer: dict[str, Any]
    feedback: str | None
    object_id: str | None


class HistoryStore:
    """The database in one file, which is created if it is missing, with at most `max_queries` without feedback.

    Raises:
        BadInput: The file is not a database of this version.
    """

    def __init__(self, path: Path, max_queries: int = 5_000) -> None:
        self.path, self._max_queries, self._lock = path, max_queries, Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._database = sqlite3.connect(path, check_same_thread=False)
            execute = self._database.execute
            execute("PRAGMA journal_mode = WAL")
            execute("PRAGMA foreign_keys = ON")
            version = execute("PRAGMA user_version").fetchone()[0]
            if version != _VERSION and execute("SELECT 1 FROM sqlite_master").fetchone():
                raise sqlite3.DatabaseError(f"it has version {version}, not {_VERSION}")
            self._database.executescript(_SCHEMA)
        except (sqlite3.Error, OSError) as error:
            raise BadInput(f"{path} must be the history of a service, and writable: {error}. {ADVICE}") from error
        self._database.create_function("casefold", 1, str.casefold, deterministic=True)

    def close(self) -> None:
        """Write the log into the file, and close the file."""
        with self._lock:
            self._database.close()

    @contextmanager
    def _transaction(self, synchronous: str = "FULL") -> Iterator[sqlite3.Connection]:
        """Run a transaction of one thread; with "FULL" it is on the disk at the end. Raises RetrievalError."""
        with self._lock:
            try:
                self._database.execute(f"PRAGMA synchronous = {synchronous}")
                with self._database as database:
                    yield database
            except sqlite3.Error as error:
                raise RetrievalError(f"{self.path} cannot be read or written: {error}") from error

    def _read(self, text: str, values: Sequence[Any] = ()) -> list[Any]:
        with self._transaction() as database:
            return database.execute(text, values).fetchall()

    # Queries ------------------------------------------------------------------------------------------------

    def add_query(
        self, name: str, touches: Sequence[Sequence[bytes]], background: Sequence[bytes] | None, result: QueryResult
    ) -> None:
        """Store a query with its image files and its answer; delete the oldest queries without feedback."""
        pictures = [
            (name, number, ascii_lowercase[finger], data)
            for number, images in enumerate([background or (), *touches])
            for finger, data in enumerate(images)
        ]
        best = replace_surrogates(result.results[0].object_id) if result.results else ""
        row = (name, time.time(), result.verdict, best, json.dumps(result.to_dict()))
        with self._transaction("NORMAL") as database:
            database.execute("INSERT INTO queries VALUES (?, ?, ?, ?, ?)", row)
            database.executemany("INSERT INTO pictures VALUES (?, ?, ?, ?)", pictures)
            database.execute(
                """DELETE FROM queries WHERE id IN (SELECT id FROM queries
                WHERE id NOT IN (SELECT query FROM feedback) ORDER BY id DESC LIMIT -1 OFFSET ?)""",
                [self._max_queries],
            )

    def history(
        self, *, words: Sequence[str] = (), feedback: str | None = None, offset: int = 0, limit: int = 100
    ) -> tuple[int, list[StoredQuery]]:
        """Return the number of matching queries, and one page of them, the newest first.

        Args:
            words: Words that must all occur in the verdict, the object or the feedback.
            feedback: `RIGHT`, `OBJECT`, `NONE`, "missing" for queries without feedback, or None for all.
            offset: Number of matches to skip.
            limit: Maximum number of queries to return.
        """
        text = "verdict || char(10) || best || char(10) || ifnull(feedback, '') || char(10) || ifnull(object_id, '')"
        conditions = [f"instr(casefold({text}), ?) > 0"] * len(words)
        values: list[Any] = [word.casefold() for word in words]
        if feedback == "missing":
            conditions.append("feedback IS NULL")
        elif feedback is not None:
            conditions.append("feedback = ?")
            values.append(feedback)
        where = f"FROM queries LEFT JOIN feedback ON query = id WHERE {' AND '.join(conditions) or '1'}"
        total = self._read(f"SELECT COUNT(*) {where}", values)[0][0]
        rows = self._read(f"SELECT {_COLUMNS} {where} ORDER BY id DESC LIMIT ? OFFSET ?", [*values, limit, offset])
        return total, [_stored_query(row) for row in rows]

    def query(self, name: str) -> StoredQuery | None:
        """Return a query by its id, or None if it is missing."""
        rows = self._read(f"SELECT {_COLUMNS} FROM queries LEFT JOIN feedback ON query = id WHERE id = ?", [name])  # noqa: S608
        return _stored_query(rows[0]) if rows else None

    def pictures(self, name: str) -> dict[tuple[int, str], bytes]:
        """Return the files of all gel images of a query, by grasp (from 1; `BACKGROUND`: no contact) and finger."""
        text = "SELECT grasp, finger, data FROM pictures WHERE query = ? ORDER BY grasp, finger"
        return {(grasp, finger): data for grasp, finger, data in self._read(text, [name])}

    # Feedback -------------------------------------------------------------------------------------------------

    def add_feedback(self, name: str, feedback: str, object_id: str | None, photo: bytes | None) -> bool:
        """Store the feedback on a query, and the file of the object's photo.

        Feedback without a photo is stored, but its grasps are not added to the recording.

        Returns:
            True if the feedback is new, False if the same feedback is stored already.

        Raises:
            BadInput: Different feedback is stored already.
        """
        with self._transaction() as database:
            text = "SELECT feedback, object_id FROM queries LEFT JOIN feedback ON query = id WHERE id = ?"
            before = database.execute(text, [name]).fetchone()
            if before == (feedback, object_id):
                return False
            if before[0] is not None:
                stored = f"{before[0]}, {before[1] or 'no object'}"
                raise BadInput(f"This query has different feedback already: {stored}.")
            database.execute(
                "INSERT INTO feedback VALUES (?, ?, ?, ?, ?)", (name, time.time(), feedback, object_id, photo)
            )
        return True

    def recordable(self) -> list[str]:
        """Return the queries with feedback on an object that has a photo, in the order of the feedback."""
        text = "SELECT query FROM feedback WHERE photo IS NOT NULL ORDER BY time, query"
        return [name for (name,) in self._read(text)]

    def feedback(self, name: str) -> tuple[str, bytes, dict[str, Any]]:
        """Return the object of a recordable query, its photo, and the query as its answer describes it."""
        text = "SELECT object_id, photo, answer FROM feedback JOIN queries ON id = query WHERE query = ?"
        ((object_id, photo, answer),) = self._read(text, [name])
        return object_id, photo, json.loads(answer)["query"]


_COLUMNS = "id, queries.time, verdict, answer, feedback, object_id"


def _stored_query(row: tuple[Any, ...]) -> StoredQuery:
    name, unix_time, verdict, answer, feedback, object_id = row
    return StoredQuery(name, unix_time, verdict, replace_surrogates(json.loads(answer)), feedback, object_id)


# Writing --------------------------------------------------------------------------------------------------------------


class Recorder(Protocol):
    """The used part of `robot.RecordingWriter`."""

    @property
    def grasp_ids(self) -> Set[str]:
        """The ids of the recorded grasps."""

    def append(self, grasp_id: str, object_id: str, images: Mapping[str, bytes], **fields: Any) -> object:
        """Record a grasp; it is on the disk when the method returns."""


class HistoryWriter:
    """Writer of the database, and of the recording in the same folder (`recorder`)."""

    def __init__(self, folder: Path, recorder: Recorder) -> None:
        self.store = HistoryStore(folder / HISTORY)
        self._recorder, self._lock = recorder, Lock()

    async def add_query(self, pictures: RequestPictures, result: QueryResult) -> str | None:
        """Store a query; return its id, or None if it cannot be stored, such as on a full disk."""
        query_id = f"{time.time_ns() // 1_000_000:011x}{secrets.token_hex(6)}"  # sorts by time; nobody can guess it
        try:
            await asyncio.to_thread(self.store.add_query, query_id, pictures.files, pictures.background, result)
        except Exception as error:
            log.warning("A query is not stored: %s", error)
            return None
        return query_id

    def record_pending(self) -> None:
        """Record the feedback that is not recorded yet.

        A failure is logged. The next call tries again, because the database contains the feedback.
        """
        with self._lock:
            for query_id in self.store.recordable():
                if not self.is_recorded(query_id):
                    try:
                        self._record(query_id)
                    except Exception:
                        log.exception("The stored feedback on query %s cannot be recorded yet.", query_id)

    def is_recorded(self, query_id: str) -> bool:
        """Whether the grasps of a query are in the recording: checks the first one, which is recorded last."""
        return f"{query_id}-00" in self._recorder.grasp_ids

    def _record(self, query_id: str) -> None:
        """Record each grasp with contact; the first one last, because `is_recorded` checks only that one."""
        object_id, photo, query = self.store.feedback(query_id)
        pictures, openings = self.store.pictures(query_id), query.get("opening_mm") or [None] * len(query["grasps"])
        contact_grasps = [number for number, gel_check in enumerate(query["grasps"], start=1) if gel_check == CONTACT]
        for place, number in reversed(list(enumerate(contact_grasps))):
            grasp_id = f"{query_id}-{place:02}"
            if grasp_id in self._recorder.grasp_ids:
                continue
            endings, images = {number: "", BACKGROUND: "_before"}, {"photo": as_png_or_jpeg(photo)}
            for (grasp, finger), data in pictures.items():
                if grasp in endings:
                    images[f"touch_{finger}{endings[grasp]}"] = as_png_or_jpeg(data)
            fields = {"grasped": True, "opening_mm": openings[number - 1], "sequence_id": query_id}
            self._recorder.append(grasp_id, object_id, images, **fields)


def as_png_or_jpeg(data: bytes) -> bytes:
    """Return an image file as PNG or JPEG; other formats become PNG. Raises ImageError if it cannot be decoded."""
    if data.startswith(tuple(IMAGE_TYPES)):
        return data
    return encode_image(np.rint(255 * decode_rgb(data, "a picture")).astype(np.uint8))
