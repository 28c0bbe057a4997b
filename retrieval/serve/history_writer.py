"""Writer of the query history, and of a recording of the feedback.

The database is authoritative. The recording, which `retrieve train` and `retrieve check` read, is updated after each
feedback and at the start. This layer does not import `robot`: the command passes the recording's writer.
"""

import asyncio
import logging
from collections.abc import Mapping, Set
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any, Protocol

import numpy as np

from retrieval.data.images import decode, encode_image
from retrieval.model.gel_check import CONTACT
from retrieval.search.answer import QueryResult
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.store import BACKGROUND, HistoryStore, new_id
from retrieval.serve.uploads import RequestPictures

log = logging.getLogger(__name__)
STORE_S = 1.0
"""Maximum time for which an answer waits until its query is stored; a slow or hanging disk takes longer."""
MAX_PENDING_WRITES = 16
"""Maximum number of queries that wait for the disk; further queries are not stored."""
_PNG_OR_JPEG = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")


class Recorder(Protocol):
    """The used part of `robot.RecordingWriter`."""

    @property
    def grasp_ids(self) -> Set[str]:
        """The ids of the recorded grasps."""

    def append(self, grasp_id: str, object_id: str, images: Mapping[str, bytes], **fields: Any) -> object:
        """Record a grasp; it is on the disk when the method returns."""


class HistoryWriter:
    """Writer of the database and of the recording in a folder.

    Args:
        folder: Folder of the history.
        recorder: Writer of the recording in that folder.
        settings: Options of the service.
    """

    def __init__(self, folder: Path, recorder: Recorder, settings: ServiceSettings) -> None:
        self.store = HistoryStore(folder / "history.sqlite", settings.history_max_queries)
        self._recorder, self._lock = recorder, Lock()
        self._writer, self._pending = ThreadPoolExecutor(1, "history"), 0

    async def add_query(self, pictures: RequestPictures, result: QueryResult) -> str | None:
        """Store a query; return its id, or None if it cannot be stored within `STORE_S`."""
        query_id = new_id()
        try:
            if self._pending >= MAX_PENDING_WRITES:
                raise TimeoutError
            self._pending += 1
            row = query_id, pictures.files, pictures.background, result
            writing = asyncio.wrap_future(self._writer.submit(self.store.add_query, *row))
            writing.add_done_callback(self._count_down)
            await asyncio.wait_for(asyncio.shield(writing), STORE_S)
        except Exception as error:
            log.warning("A query is not stored: %s", str(error) or "the disk takes too long")
            return None
        return query_id

    def _count_down(self, writing: asyncio.Future[None]) -> None:
        self._pending -= 1
        if not writing.cancelled():
            writing.exception()  # mark as retrieved: the answer may have been sent without waiting

    def record_pending(self) -> None:
        """Record the feedback that is not recorded yet.

        A failure is logged. The next call tries again, because the database contains the feedback.
        """
        with self._lock:
            for query_id, object_id in self.store.recordable():
                if not self.is_recorded(query_id):
                    try:
                        self._record(query_id, object_id)
                    except Exception:
                        log.exception("The stored feedback on query %s cannot be recorded yet.", query_id)

    def is_recorded(self, query_id: str) -> bool:
        """Whether the grasps of a query are in the recording: checks the first one, which is recorded last."""
        return f"{query_id}-00" in self._recorder.grasp_ids

    def _record(self, query_id: str, object_id: str) -> None:
        """Record each grasp with contact; the first one last, because `is_recorded` checks only that one."""
        stored, photo = self.store.query(query_id), self.store.photo(query_id)
        assert stored is not None, "a foreign key protects queries with feedback"
        assert photo is not None, "recordable feedback has a photo"
        pictures, gel_checks = self.store.pictures(query_id), stored.answer["query"]["grasps"]
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

    def close(self) -> None:
        """Write the waiting queries, and close the database."""
        self._writer.shutdown()
        self.store.close()


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
