"""Reader of a free-running camera: a thread reads all frames with their times and buffers the newest few.

Frames are buffered as the camera delivers them (BGR); rotation, crop and colour order are applied only on reading. A
frame equal to the previous one is dropped, so a frozen stream becomes stale. The thread owns the stream.
When the stream fails, ends or freezes, the thread closes it and opens it again, with increasing delays. Until a new
frame arrives, readers wait; after the timeout they raise with the reason.
"""

import contextlib
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from robot.devices import Clock
from robot.errors import DeviceError
from robot.readings import Frame
from robot.settings import TypedSettings, bounded

log = logging.getLogger(__name__)
MAX_CAMERA_WAIT_S = 600.0
"""Upper limit of all camera timeouts; the system's own waits overflow at some length."""

_CLOSING_S = 5.0
"""Time in which the thread must return from the camera's driver before `close` raises."""

ARRIVALS = 1000
"""Number of frames whose arrival is remembered."""

_SAMPLE = 16
"""Every 16th row and column are compared first, because they differ in nearly any two pictures."""


@dataclass(frozen=True)
class Arrival:
    """One frame of the stream: its time, and whether it equals the frame before."""

    time_s: float
    is_repeat: bool


class Stream(Protocol):
    """An opened camera. One thread at a time calls its methods."""

    def next(self) -> Frame:
        """Wait for the next frame, (H, W, 3) uint8 BGR; raise DeviceError or OSError if none arrives."""

    def close(self) -> None:
        """Release the camera."""


@dataclass(frozen=True, kw_only=True)
class ReaderSettings(TypedSettings):
    """Settings of a frame reader.

    Attributes:
        keep: Number of buffered frames.
        warmup_s: Time after opening in which frames are dropped (automatic exposure, first black frames).
        timeout_s: Longest wait for a frame.
        frozen_s: Duration of equal frames after which the stream is opened again; they are stale long before.
    """

    keep: int = bounded(1, 1000, 4, unit="pictures")
    warmup_s: float = bounded(0, MAX_CAMERA_WAIT_S, 1.0, unit="s")
    timeout_s: float = bounded(1e-3, MAX_CAMERA_WAIT_S, 3.0, unit="s")
    frozen_s: float = bounded(1e-3, MAX_CAMERA_WAIT_S, 2.0, unit="s")


class FrameReader:
    """Reads streams in a thread of its own, from `start` to `close`.

    Args:
        name: Name of the camera in messages.
        open_stream: Opens the stream.
        settings: Settings of the reader.
        clock: Clock of the frames' times.
        backoff_s: First and longest wait before a lost stream is opened again.

    Attributes:
        frame_count: Frames read, dropped ones included.
        lost_count: Failures of the stream, failed reopenings included.
    """

    def __init__(
        self,
        name: str,
        open_stream: Callable[[], Stream],
        settings: ReaderSettings,
        *,
        clock: Clock = time.monotonic,
        backoff_s: tuple[float, float] = (0.1, 5.0),
    ) -> None:
        self.name, self.settings, self.clock, self.backoff_s = name, settings, clock, backoff_s
        self.frame_count = self.lost_count = 0
        self._arrivals: deque[Arrival] = deque(maxlen=ARRIVALS)
        self._open_stream = open_stream
        self._frames: deque[Frame] = deque(maxlen=settings.keep)
        self._changed = threading.Condition()
        self._stopped, self._reopen = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._last: Frame | None = None
        self._warm_s = 0.0
        self._last_error = "no frame arrived"

    @property
    def arrivals(self) -> list[Arrival]:
        """The newest ARRIVALS frames, dropped ones included."""
        with self._changed:
            return list(self._arrivals)

    def start(self) -> None:
        """Open the stream and wait for its first frame; after a DeviceError or OSError, call `close`."""
        stream = self._open()
        self._thread = threading.Thread(target=self._run, args=(stream,), name=f"frames of {self.name}", daemon=True)
        self._thread.start()
        self._wait(self.settings.timeout_s + self.settings.warmup_s)

    def newest(self) -> Frame:
        """Return the newest frame; wait if there is none yet or none since the stream was lost.

        Raises:
            DeviceError: No frame arrived within `timeout_s`.
        """
        return self._wait(self.settings.timeout_s)[-1]

    def after(self, time_s: float, timeout_s: float | None = None) -> Frame:
        """Wait for a frame newer than `time_s` and return the newest frame.

        Args:
            time_s: A time on the reader's clock.
            timeout_s: Longest wait; None for `timeout_s` + `warmup_s` of the settings: a lost stream warms up again.

        Raises:
            DeviceError: No such frame arrived in this time.
        """
        if timeout_s is None:
            timeout_s = self.settings.timeout_s + self.settings.warmup_s
        return self._wait(timeout_s, time_s)[-1]

    def near(self, time_s: float) -> Frame:
        """Return the buffered frame nearest to `time_s`, on a tie the newer one; raise DeviceError without frames."""
        return min(self._wait(self.settings.timeout_s), key=lambda frame: (abs(frame.time_s - time_s), -frame.time_s))

    def reopen_now(self) -> None:
        """Open a lost stream again without further delay."""
        self._reopen.set()

    def close(self) -> None:
        """Stop the thread, which closes the stream; raise DeviceError if the camera's driver blocks it."""
        self._stopped.set()
        self._reopen.set()
        if self._thread is None:
            return
        self._thread.join(_CLOSING_S)
        if self._thread.is_alive():
            raise DeviceError(
                f"{self.name} did not close within {_CLOSING_S:g} s, because its driver still waits for a picture; "
                "it closes when the driver returns. If the driver does not return, unplug the camera"
            )

    def _open(self) -> Stream:
        stream = self._open_stream()
        self._warm_s = self.clock() + self.settings.warmup_s
        return stream

    def _wait(self, timeout_s: float, since_s: float = -math.inf) -> list[Frame]:
        with self._changed:
            if not self._changed.wait_for(lambda: bool(self._frames) and self._frames[-1].time_s > since_s, timeout_s):
                raise DeviceError(
                    f"{self.name} returned no picture within {timeout_s:g} s: {self._last_error}; reading or "
                    f"reopening failed {self.lost_count} time(s). Is it plugged in, and used by no other program?"
                )
            return list(self._frames)

    def _run(self, stream: Stream | None) -> None:
        shortest, longest = self.backoff_s
        delay = shortest
        while not self._stopped.is_set():
            try:
                stream = stream or self._open()
                self._store(stream.next())
                delay = shortest
            except Exception as error:  # the thread must survive, and readers get the reason
                self._handle_failure(stream, error, delay)
                stream = None
                self._reopen.wait(delay)
                self._reopen.clear()
                delay = min(2 * delay, longest)
        if stream is not None:
            _close_quietly(stream)

    def _store(self, frame: Frame) -> None:
        """Buffer a new frame; drop a repeat of the last frame, whose time stays unchanged."""
        with self._changed:
            self.frame_count += 1
            is_repeat = self._last is not None and _is_same_picture(self._last.pixels, frame.pixels)
            self._arrivals.append(Arrival(frame.time_s, is_repeat))
            if self._last is not None and is_repeat:
                if (still_s := frame.time_s - self._last.time_s) > self.settings.frozen_s:
                    raise DeviceError(f"its stream is frozen: the same picture for {still_s:.1f} s")
                return
            self._last = frame
            if frame.time_s >= self._warm_s:
                self._frames.append(frame)
                self._changed.notify_all()

    def _handle_failure(self, stream: Stream | None, error: Exception, delay: float) -> None:
        with self._changed:
            self._frames.clear()
            self._last_error = str(error) or type(error).__name__
            self.lost_count += 1
        log.warning("%s: %s; reopening in %.2g s (loss %d)", self.name, self._last_error, delay, self.lost_count)
        if stream is not None:
            _close_quietly(stream)


def _close_quietly(stream: Stream) -> None:
    with contextlib.suppress(Exception):
        stream.close()


def _is_same_picture(one: np.ndarray, other: np.ndarray) -> bool:
    sample = np.s_[::_SAMPLE, ::_SAMPLE]
    return np.array_equal(one[sample], other[sample]) and np.array_equal(one, other)
