"""The history of queries, written off their way, and what people said of them as a recording.

An answer does not wait for the disk. `retrieve train` and `retrieve check` read the recording as it is. The database is
the truth; the recording is brought up to it after each word, and when the service starts. Writing one is the business
of `robot`, of which this layer knows nothing: the command hands in the writer.
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
"""Queries that wait to be written at once; with more the disk is slower than the model, and they are left out."""
DRAIN_TIMEOUT_S = 2.0
"""How long a request of the history waits for queries that are being written."""
_MAX_FAILURES = 1000
"""Queries that could not be stored, whose reasons are remembered."""
_PNG_OR_JPEG = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")


class Recorder(Protocol):
    """The part of `robot.RecordingWriter` that is used here."""

    @property
    def grasp_ids(self) -> Set[str]:
        """The ids of the grasps that are recorded."""

    def append(self, grasp_id: str, object_id: str, images: Mapping[str, bytes], **fields: Any) -> object:
        """Record a grasp; it is on the disk when this returns."""


class FeedbackRecording:
    """The recording, brought up to the database by one thread at a time."""

    def __init__(self, store: HistoryStore, recorder: Recorder, metrics: Metrics) -> None:
        self._store, self._recorder, self._metrics, self._lock = store, recorder, metrics, Lock()

    def record_pending(self) -> None:
        """Record the feedback that is not recorded yet. Failures are logged, and tried again after the next feedback:
        the database has it.
        """
        with self._lock:
            try:
                waiting = self._store.recordable()
            except Exception:
                log.exception("feedback is stored, and cannot be recorded yet")
                return
            for name, object_id in waiting:
                if self.contains(name):
                    continue
                try:
                    self._record(name, object_id)
                except Exception:
                    self._metrics.history_failures.labels("said").inc()
                    log.exception("what was said of %s is kept, and cannot be recorded yet", name)

    def contains(self, name: str) -> bool:
        """Whether the grasps of a query are in the recording."""
        return f"{name}-00" in self._recorder.grasp_ids

    def _record(self, name: str, object_id: str) -> None:
        """A grasp for each that felt something; the first one last, for it stands for all of them."""
        stored, photo = self._store.query(name), self._store.photo(name)
        assert stored is not None, "the database holds it to what was said"
        assert photo is not None, "it is recordable"
        pictures, gel_checks = self._store.pictures(name), stored.answer["query"]["grasps"]
        before = {finger: data for (grasp, finger), data in pictures.items() if grasp == BACKGROUND}
        contact_grasps = [number for number, what in enumerate(gel_checks, start=1) if what == CONTACT]
        for place, number in reversed(list(enumerate(contact_grasps))):
            grasp_id = f"{name}-{place:02}"
            if grasp_id in self._recorder.grasp_ids:
                continue
            images = {"photo": recordable(photo)}
            images |= {
                f"touch_{finger}": recordable(data) for (grasp, finger), data in pictures.items() if grasp == number
            }
            images |= {f"touch_{finger}_before": recordable(data) for finger, data in before.items()}
            self._recorder.append(grasp_id, object_id, images, grasped=True, sequence_id=name)


def recordable(data: bytes) -> bytes:
    """A picture's file as a recording may hold it: PNG or JPEG as it is, another as PNG. Raises ImageError."""
    if data.startswith(_PNG_OR_JPEG):
        return data
    samples = decode(data, "a picture")
    pixels = samples if samples.dtype == np.uint8 else np.rint(255 * samples)
    return encode_image(pixels.astype(np.uint8, copy=False))


class HistoryWriter:
    """The database and the recording in a folder. One thread writes, whatever a write raises."""

    def __init__(self, folder: Path, recorder: Recorder, settings: ServiceSettings, metrics: Metrics) -> None:
        self.folder, self._metrics = folder, metrics
        self.store = HistoryStore(folder / "history.sqlite", settings.keep, settings.keep_bytes)
        self.recording = FeedbackRecording(self.store, recorder, metrics)
        self._writer = ThreadPoolExecutor(1, "history")
        self._pending: dict[str, Future[None]] = {}
        self._failures: OrderedDict[str, str] = OrderedDict()

    def start(self) -> None:
        """Record the feedback that was not recorded before the service ended last."""
        self._writer.submit(self.recording.record_pending)

    def keep(self, parsed_query: ParsedQuery, answered: QueryAnswer) -> str | None:
        """Have a query written soon; its id, None where too many wait."""
        if len(self._pending) >= MAX_PENDING_WRITES:
            self._metrics.history_failures.labels("query").inc()
            return None
        name = new_id()
        write = self._writer.submit(
            self._write,
            name,
            lambda: self.store.keep(name, parsed_query.pictures.files[0], parsed_query.pictures.background, *answered),
        )
        self._pending[name] = write
        write.add_done_callback(lambda _: self._pending.pop(name, None))
        return name

    def _write(self, name: str, write: Callable[[], None]) -> None:
        """Write a query. A failure is logged and remembered, and ends nothing."""
        try:
            write()
        except BaseException as error:
            self._metrics.history_failures.labels("query").inc()
            log.warning("query %s is not stored: %s", name, error, exc_info=not isinstance(error, RetrievalError))
            self._failures[name] = str(error) or type(error).__name__
            if len(self._failures) > _MAX_FAILURES:
                self._failures.popitem(last=False)

    async def drain(self, seconds: float = DRAIN_TIMEOUT_S) -> None:
        """Wait until the queries that wait now are written, `seconds` at most."""
        if waiting := [asyncio.wrap_future(write) for write in list(self._pending.values())]:
            await asyncio.wait(waiting, timeout=seconds)

    def missing_query_problem(self, name: str) -> HttpProblem:
        """Why the history does not have a query of that id."""
        if name in self._pending:
            return HttpProblem("not-ready", f"query {name} is still being stored; come again", {"retry-after": "1"})
        if name in self._failures:
            return HttpProblem("unknown", f"query {name} could not be stored: {self._failures[name]}")
        return HttpProblem("unknown", f"the history has no query {name[:64]!r}; the oldest are left out")

    def close(self) -> None:
        """Close the database."""
        self._writer.shutdown(wait=False, cancel_futures=True)
        self.store.close()
