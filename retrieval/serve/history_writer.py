"""Writer of the query history, and of a recording of the feedback.

Queries are written in the background, so that an answer does not wait for the disk. The database is authoritative. The
recording, which `retrieve train` and `retrieve check` read, is updated after each feedback and at the start. This layer
does not import `robot`: the command passes the recording's writer.
"""

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable, Mapping, Set
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any, Protocol

import numpy as np

from retrieval.data.images import decode, encode_image
from retrieval.errors import RetrievalError
from retrieval.model.fusion_scorer import CONTACT
from retrieval.serve.errors import HttpProblem
from retrieval.serve.metrics import Metrics
from retrieval.serve.queue import QueryAnswer
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.store import BACKGROUND, HistoryStore, new_id
from retrieval.serve.uploads import ParsedQuery

log = logging.getLogger(__name__)
MAX_PENDING_WRITES = 64
"""Maximum number of queries that wait to be written; further queries are not stored (the disk is too slow)."""
DRAIN_TIMEOUT_S = 2.0
"""Maximum time for which a request of the history waits for pending queries."""
_MAX_FAILURES = 1000
"""Maximum number of failed writes whose reasons are kept in memory."""
_PNG_OR_JPEG = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")


class Recorder(Protocol):
    """The used part of `robot.RecordingWriter`."""

    @property
    def grasp_ids(self) -> Set[str]:
        """The ids of the recorded grasps."""

    def append(self, grasp_id: str, object_id: str, images: Mapping[str, bytes], **fields: Any) -> object:
        """Record a grasp; it is on the disk when the method returns."""


class FeedbackRecording:
    """The recording of the feedback; one thread at a time updates it from the database."""

    def __init__(self, store: HistoryStore, recorder: Recorder, metrics: Metrics) -> None:
        self._store, self._recorder, self._metrics, self._lock = store, recorder, metrics, Lock()

    def record_pending(self) -> None:
        """Record the feedback that is not recorded yet.

        A failure is logged. The next call tries again, because the database contains the feedback.
        """
        with self._lock:
            try:
                pending = self._store.recordable()
            except Exception:
                log.exception("Stored feedback cannot be recorded yet.")
                return
            for query_id, object_id in pending:
                if self.contains(query_id):
                    continue
                try:
                    self._record(query_id, object_id)
                except Exception:
                    self._metrics.history_failures.labels("feedback").inc()
                    log.exception("The stored feedback on query %s cannot be recorded yet.", query_id)

    def contains(self, query_id: str) -> bool:
        """Whether the grasps of a query are in the recording: checks the first one, which is recorded last."""
        return f"{query_id}-00" in self._recorder.grasp_ids

    def _record(self, query_id: str, object_id: str) -> None:
        """Record each grasp with contact; the first one last, because `contains` checks only that one."""
        stored, photo = self._store.query(query_id), self._store.photo(query_id)
        assert stored is not None, "a foreign key protects queries with feedback"
        assert photo is not None, "recordable feedback has a photo"
        pictures, gel_checks = self._store.pictures(query_id), stored.answer["query"]["grasps"]
        before = {finger: data for (grasp, finger), data in pictures.items() if grasp == BACKGROUND}
        contact_grasps = [number for number, gel_check in enumerate(gel_checks, start=1) if gel_check == CONTACT]
        for place, number in reversed(list(enumerate(contact_grasps))):
            grasp_id = f"{query_id}-{place:02}"
            if grasp_id in self._recorder.grasp_ids:
                continue
            images = {"photo": as_png_or_jpeg(photo)}
            images |= {
                f"touch_{finger}": as_png_or_jpeg(data) for (grasp, finger), data in pictures.items() if grasp == number
            }
            images |= {f"touch_{finger}_before": as_png_or_jpeg(data) for finger, data in before.items()}
            self._recorder.append(grasp_id, object_id, images, grasped=True, sequence_id=query_id)


def as_png_or_jpeg(data: bytes) -> bytes:
    """Return an image file in a format that a recording may contain; formats other than PNG and JPEG become PNG.

    Raises:
        ImageError: The image cannot be decoded.
    """
    if data.startswith(_PNG_OR_JPEG):
        return data
    samples = decode(data, "a picture")
    pixels = samples if samples.dtype == np.uint8 else np.rint(255 * samples)
    return encode_image(pixels.astype(np.uint8, copy=False))


class HistoryWriter:
    """Writer of the database and the recording in a folder. One thread writes; it continues after a failed write.

    Args:
        folder: Folder of the history.
        recorder: Writer of the recording in that folder.
        settings: Options of the service.
        metrics: Metrics of the service.
    """

    def __init__(self, folder: Path, recorder: Recorder, settings: ServiceSettings, metrics: Metrics) -> None:
        self.folder, self._metrics = folder, metrics
        self.store = HistoryStore(folder / "history.sqlite", settings.history_max_queries, settings.history_max_bytes)
        self.recording = FeedbackRecording(self.store, recorder, metrics)
        self._writer = ThreadPoolExecutor(1, "history")
        self._pending: dict[str, Future[None]] = {}
        self._failures: OrderedDict[str, str] = OrderedDict()

    def start(self) -> None:
        """Record feedback that a previous run of the service left unrecorded."""
        self._writer.submit(self.recording.record_pending)

    def submit(self, parsed_query: ParsedQuery, answer: QueryAnswer) -> str | None:
        """Schedule a query to be written; return its id, or None if too many queries wait."""
        if len(self._pending) >= MAX_PENDING_WRITES:
            self._metrics.history_failures.labels("query").inc()
            return None
        query_id = new_id()
        write = self._writer.submit(
            self._write,
            query_id,
            lambda: self.store.add_query(
                query_id, parsed_query.pictures.files[0], parsed_query.pictures.background, *answer
            ),
        )
        self._pending[query_id] = write
        write.add_done_callback(lambda _: self._pending.pop(query_id, None))
        return query_id

    def _write(self, query_id: str, write: Callable[[], None]) -> None:
        """Write a query. Log a failure and keep its reason; the thread continues."""
        try:
            write()
        except BaseException as error:
            self._metrics.history_failures.labels("query").inc()
            log.warning("Query %s is not stored: %s", query_id, error, exc_info=not isinstance(error, RetrievalError))
            self._failures[query_id] = str(error) or type(error).__name__
            if len(self._failures) > _MAX_FAILURES:
                self._failures.popitem(last=False)

    async def drain(self, seconds: float = DRAIN_TIMEOUT_S) -> None:
        """Wait until the currently pending queries are written, at most `seconds`."""
        if pending := [asyncio.wrap_future(write) for write in list(self._pending.values())]:
            await asyncio.wait(pending, timeout=seconds)

    def missing_query_problem(self, query_id: str) -> HttpProblem:
        """Return the problem to answer with if the history has no query with this id: it says why."""
        if query_id in self._pending:
            return HttpProblem("not-ready", f"Query {query_id} is still being stored. Try again.", {"retry-after": "1"})
        if query_id in self._failures:
            return HttpProblem("unknown", f"Query {query_id} could not be stored: {self._failures[query_id]}")
        return HttpProblem(
            "unknown",
            f"The history has no query {query_id[:64]!r}. Of queries without feedback, only the newest are kept.",
        )

    def close(self) -> None:
        """Stop the writer and close the database. Pending queries are not written; call `drain` first."""
        self._writer.shutdown(wait=False, cancel_futures=True)
        self.store.close()
