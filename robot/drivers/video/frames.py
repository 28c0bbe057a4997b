"""Pictures of a camera that never waits: a thread takes every one, notes when, and keeps the newest few.

What is kept is as the camera gives it (BGR); turning, cropping and colour order cost time and wait for a reader. A
picture that is the same as the one before counts as that one and keeps its time: a stream that stands still grows old.
The thread owns the stream. When the stream fails, ends or stands still for too long, it is closed and opened again,
waiting a little longer each time; until a new picture has come, whoever asks waits and is then told why.
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
"""Nobody waits longer for a camera, and the system's own waits overflow at some length."""

_CLOSING_S = 5.0
"""A thread that waits inside a camera's driver gets so long to come back before `close` says that it has not."""

_SAMPLE = 16
"""Every 16th row and column tells nearly any two pictures apart; only where they agree is the rest compared."""


class Stream(Protocol):
    """An opened camera. Both methods are called by one thread at a time."""

    def next(self) -> Frame:
        """Wait for the next picture: (H, W, 3) uint8 BGR. Raises DeviceError or OSError where none comes."""

    def close(self) -> None:
        """Let go of the camera."""


@dataclass(frozen=True, kw_only=True)
class ReaderSettings(TypedSettings):
    """keep: pictures kept. warmup_s: pictures so soon after opening are dropped (automatic exposure, first black ones).
    timeout_s: how long somebody who asks waits for a picture. frozen_s: a stream of the same pixels for longer is
    opened again; its picture is too old to be used long before that. Raises RobotConfigError for one out of range.
    """

    keep: int = bounded(1, 1000, 4, unit="pictures")
    warmup_s: float = bounded(0, MAX_CAMERA_WAIT_S, 1.0, unit="s")
    timeout_s: float = bounded(1e-3, MAX_CAMERA_WAIT_S, 3.0, unit="s")
    frozen_s: float = bounded(1e-3, MAX_CAMERA_WAIT_S, 2.0, unit="s")


class FrameReader:
    """Reads the streams that `open_stream` opens, in a thread of its own, from `start` to `close`.

    frame_count: pictures taken, the dropped ones included. lost: how often a stream was given up. backoff_s: first and
    longest wait before it is opened again.
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
        self._open_stream = open_stream
        self._frames: deque[Frame] = deque(maxlen=settings.keep)
        self._changed = threading.Condition()
        self._stopped, self._reopen = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._last: Frame | None = None
        self._warm_s = 0.0
        self._last_error = "nothing came"

    def start(self) -> None:
        """Open the stream and wait for its first picture. Raises DeviceError or OSError; then `close` is due."""
        stream = self._open()
        self._thread = threading.Thread(target=self._run, args=(stream,), name=f"frames of {self.name}", daemon=True)
        self._thread.start()
        self._wait(self.settings.timeout_s + self.settings.warmup_s)

    def newest(self) -> Frame:
        """The newest picture; waits for one where there is none yet, or none since the stream was lost.

        Raises DeviceError after `timeout_s`.
        """
        return self._wait(self.settings.timeout_s)[-1]

    def after(self, time_s: float) -> Frame:
        """Wait for a picture newer than `time_s`. Raises DeviceError after `timeout_s` and the time to warm up, which a
        stream that was lost takes again.
        """
        return self._wait(self.settings.timeout_s + self.settings.warmup_s, time_s)[-1]

    def near(self, time_s: float) -> Frame:
        """Of the kept pictures the one taken nearest to `time_s`, the newer one of two. Raises DeviceError."""
        return min(self._wait(self.settings.timeout_s), key=lambda frame: (abs(frame.time_s - time_s), -frame.time_s))

    def reopen_now(self) -> None:
        """Open a lost stream again now."""
        self._reopen.set()

    def close(self) -> None:
        """End the thread, which lets go of the stream. Raises DeviceError where the camera's driver holds it up."""
        self._stopped.set()
        self._reopen.set()
        if self._thread is None:
            return
        self._thread.join(_CLOSING_S)
        if self._thread.is_alive():
            raise DeviceError(
                f"{self.name} must end within {_CLOSING_S:g} s, but its driver still waits for a picture; "
                "it is let go as soon as that returns. Unplug it if that does not help"
            )

    def _open(self) -> Stream:
        stream = self._open_stream()
        self._warm_s = self.clock() + self.settings.warmup_s
        return stream

    def _wait(self, timeout_s: float, since_s: float = -math.inf) -> list[Frame]:
        with self._changed:
            if not self._changed.wait_for(lambda: bool(self._frames) and self._frames[-1].time_s > since_s, timeout_s):
                raise DeviceError(
                    f"{self.name} must give a picture within {timeout_s:g} s: {self._last_error}; it was lost {self.lost_count} "
                    "time(s). Is it plugged in, and used by no other program?"
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
            except Exception as error:  # whatever it is, the thread must live, and whoever asks must hear of it
                self._handle_failure(stream, error, delay)
                stream = None
                self._reopen.wait(delay)
                self._reopen.clear()
                delay = min(2 * delay, longest)
        if stream is not None:
            _close_quietly(stream)

    def _store(self, frame: Frame) -> None:
        """Keep a new picture; one that repeats the last is as old as its first copy, and is not kept again."""
        with self._changed:
            self.frame_count += 1
            if self._last is not None and _is_same_picture(self._last.pixels, frame.pixels):
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
        log.warning("%s: %s; opened again in %.2g s (time %d)", self.name, self._last_error, delay, self.lost_count)
        if stream is not None:
            _close_quietly(stream)


def _close_quietly(stream: Stream) -> None:
    with contextlib.suppress(Exception):
        stream.close()


def _is_same_picture(one: np.ndarray, other: np.ndarray) -> bool:
    sample = np.s_[::_SAMPLE, ::_SAMPLE]
    return np.array_equal(one[sample], other[sample]) and np.array_equal(one, other)
