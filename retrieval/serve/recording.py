"""What people said of queries, as a recording that `retrieve train` and `retrieve check` read as it is.

The database is the truth; the recording is brought up to it after each word, and when the service starts. Writing one
is the business of `robot`, of which this layer knows nothing: the command hands in the writer.
"""

import logging
from collections.abc import Mapping, Set
from threading import Lock
from typing import Any, Protocol

import cv2
import numpy as np

from retrieval.data.images import decode
from retrieval.model.judge import CONTACT
from retrieval.serve.metrics import Metrics
from retrieval.serve.store import BACKGROUND, Store

log = logging.getLogger(__name__)
_RECORDABLE = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")


class Recorder(Protocol):
    """The part of `robot.RecordingWriter` that is used here."""

    @property
    def grasp_ids(self) -> Set[str]:
        """The ids of the grasps that are recorded."""

    def append(self, grasp_id: str, object_id: str, images: Mapping[str, bytes], **fields: Any) -> object:
        """Record a grasp; it is on the disk when this returns."""


class SaidRecording:
    """The recording, brought up to the database by one thread at a time."""

    def __init__(self, store: Store, recorder: Recorder, metrics: Metrics) -> None:
        self._store, self._recorder, self._metrics, self._lock = store, recorder, metrics, Lock()

    def bring_up(self) -> None:
        """Record the feedback that is not recorded yet. Failures are logged, and tried again after the next feedback:
        the database has it."""
        with self._lock:
            try:
                waiting = self._store.recordable()
            except Exception:
                log.exception("feedback is stored, and cannot be recorded yet")
                return
            for name, object_id in waiting:
                if self.holds(name):
                    continue
                try:
                    self._record(name, object_id)
                except Exception:
                    self._metrics.unrecorded.labels("said").inc()
                    log.exception("what was said of %s is kept, and cannot be recorded yet", name)

    def holds(self, name: str) -> bool:
        """Whether the grasps of a query are in the recording."""
        return f"{name}-00" in self._recorder.grasp_ids

    def _record(self, name: str, object_id: str) -> None:
        """A grasp for each that felt something; the first one last, for it stands for all of them."""
        kept, photo = self._store.query(name), self._store.photo(name)
        assert kept is not None, "the database holds it to what was said"
        assert photo is not None, "it is recordable"
        pictures, shown = self._store.pictures(name), kept.answer["query"]["grasps"]
        before = {finger: data for (grasp, finger), data in pictures.items() if grasp == BACKGROUND}
        felt = [number for number, what in enumerate(shown, start=1) if what == CONTACT]
        for place, number in reversed(list(enumerate(felt))):
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
    if data.startswith(_RECORDABLE):
        return data
    samples = decode(data, "a picture")
    pixels = samples if samples.dtype == np.uint8 else np.rint(255 * samples).astype(np.uint8)
    return bytes(cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())
