"""What is kept of queries, off their way: an answer does not wait for the disk."""

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path

from retrieval.errors import RetrievalError
from retrieval.serve.metrics import Metrics
from retrieval.serve.queue import Answered
from retrieval.serve.recording import Recorder, SaidRecording
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.store import Store, new_id
from retrieval.serve.uploads import Asked

log = logging.getLogger(__name__)
WAITING = 64
"""Queries that wait to be written at once; with more the disk is slower than the model, and they are left out."""


class Keeping:
    """The database and the recording in a folder."""

    def __init__(self, folder: Path, recorder: Recorder, settings: ServiceSettings, metrics: Metrics) -> None:
        self.folder, self._metrics = folder, metrics
        self.store = Store(folder / "history.sqlite", settings.keep, settings.keep_bytes)
        self.recording = SaidRecording(self.store, recorder, metrics)
        self._waiting: asyncio.Queue[Callable[[], None]] = asyncio.Queue(WAITING)

    def keep(self, asked: Asked, answered: Answered) -> str | None:
        """Have a query written soon; its id, None where too many wait."""
        name = new_id()
        try:
            self._waiting.put_nowait(lambda: self.store.keep(name, asked.touches, asked.background, *answered))
        except asyncio.QueueFull:
            self._metrics.unrecorded.labels("query").inc()
            return None
        return name

    async def written(self) -> None:
        """When what waits now is written."""
        await self._waiting.join()

    async def work(self) -> None:
        """What must run for anything to be written."""
        await asyncio.to_thread(self.recording.bring_up)
        while True:
            write = await self._waiting.get()
            try:
                await asyncio.to_thread(write)
            except RetrievalError as error:
                self._metrics.unrecorded.labels("query").inc()
                log.warning("a query is not kept: %s", error)
            finally:
                self._waiting.task_done()

    def close(self) -> None:
        """Let go of the database."""
        self.store.close()
