"""The history of queries, written off their way: an answer does not wait for the disk."""

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from retrieval.errors import RetrievalError
from retrieval.serve.errors import Problem
from retrieval.serve.metrics import Metrics
from retrieval.serve.queue import Answered
from retrieval.serve.recording import Recorder, SaidRecording
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.store import Store, new_id
from retrieval.serve.uploads import Asked

log = logging.getLogger(__name__)
WAITING = 64
"""Queries that wait to be written at once; with more the disk is slower than the model, and they are left out."""
WRITTEN_S = 2.0
"""How long a request of the history waits for queries that are being written."""
_REMEMBERED = 1000
"""Queries that could not be stored, whose reasons are remembered."""


class Keeping:
    """The database and the recording in a folder. One thread writes, whatever a write raises."""

    def __init__(self, folder: Path, recorder: Recorder, settings: ServiceSettings, metrics: Metrics) -> None:
        self.folder, self._metrics = folder, metrics
        self.store = Store(folder / "history.sqlite", settings.keep, settings.keep_bytes)
        self.recording = SaidRecording(self.store, recorder, metrics)
        self._writer = ThreadPoolExecutor(1, "history")
        self._waiting: dict[str, Future[None]] = {}
        self._lost: OrderedDict[str, str] = OrderedDict()

    def start(self) -> None:
        """Record the feedback that was not recorded before the service ended last."""
        self._writer.submit(self.recording.bring_up)

    def keep(self, asked: Asked, answered: Answered) -> str | None:
        """Have a query written soon; its id, None where too many wait."""
        if len(self._waiting) >= WAITING:
            self._metrics.unrecorded.labels("query").inc()
            return None
        name = new_id()
        write = self._writer.submit(
            self._attempt, name, lambda: self.store.keep(name, asked.touches, asked.background, *answered)
        )
        self._waiting[name] = write
        write.add_done_callback(lambda _: self._waiting.pop(name, None))
        return name

    def _attempt(self, name: str, write: Callable[[], None]) -> None:
        """Write a query. A failure is logged and remembered, and ends nothing."""
        try:
            write()
        except BaseException as error:
            self._metrics.unrecorded.labels("query").inc()
            log.warning("query %s is not stored: %s", name, error, exc_info=not isinstance(error, RetrievalError))
            self._lost[name] = str(error) or type(error).__name__
            if len(self._lost) > _REMEMBERED:
                self._lost.popitem(last=False)

    async def written(self, seconds: float = WRITTEN_S) -> None:
        """Wait until the queries that wait now are written, `seconds` at most."""
        if waiting := [asyncio.wrap_future(write) for write in list(self._waiting.values())]:
            await asyncio.wait(waiting, timeout=seconds)

    def absence(self, name: str) -> Problem:
        """Why the history does not have a query of that id."""
        if name in self._waiting:
            return Problem("not-ready", f"query {name} is still being stored; come again", {"retry-after": "1"})
        if name in self._lost:
            return Problem("unknown", f"query {name} could not be stored: {self._lost[name]}")
        return Problem("unknown", f"the history has no query {name[:64]!r}; the oldest are left out")

    def close(self) -> None:
        """Close the database."""
        self._writer.shutdown(wait=False, cancel_futures=True)
        self.store.close()
