"""The picture stream of a USB camera: OpenCV and Video4Linux, read by a thread that buffers the newest few frames.

Facts used (OpenCV's cap_v4l.cpp; the kernel's uvcvideo): a change of format, size or buffers restarts the stream, so
these are set first, width directly before height. A control that a camera lacks reads -1. Automatic exposure is a
menu with 1 = manual and 3 = automatic; exposure is in units of 0.1 ms. CAP_PROP_POS_MSEC is the time at which the
picture's buffer was filled, on the clock of time.monotonic. grab() times out after OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT
seconds, 10 by default.

Frames are buffered as the camera delivers them (BGR); rotation, crop and colour order are applied only on reading. A
frame equal to the previous one is dropped, so a frozen stream becomes stale. The thread owns the stream. When the
stream fails, ends or freezes, the thread closes it and opens it again, with increasing delays. Until a new frame
arrives, readers wait; after the timeout they raise with the reason.
"""

import contextlib
import logging
import math
import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from msgspec import Meta

from _touch_retrieval.documents import NonNegative
from robot.devices import Clock
from robot.drivers import discover
from robot.errors import DeviceError, RobotConfigError
from robot.readings import Frame
from robot.settings import TypedSettings

log = logging.getLogger(__name__)
MAX_CAMERA_WAIT_S = 600.0
"""Upper limit of all camera timeouts; the system's own waits overflow at some length."""

_CLOSING_S = 5.0
"""Time in which the thread must return from the camera's driver before `close` raises."""


BACKOFF_S = 0.1, 5.0
"""First and longest wait before a lost stream is opened again."""
_DAMAGED_IN_A_ROW = 10
"""Number of consecutive undecodable pictures that are skipped before the stream is considered lost."""

_STAMP_S = (-0.05, 1.0)
"""Accepted ages of a picture's own time stamp in s; a stamp outside this range is on another clock."""

_Level = Annotated[int, Meta(ge=0, le=15)]
_NUMBERED = re.compile(r"/dev/video\d+")


@dataclass(frozen=True, kw_only=True)
class UsbCameraSettings(TypedSettings):
    """Settings of a USB camera; what is None is not changed.

    Attributes:
        device: Path in /dev/v4l/by-id, or in by-path (the socket); such as /dev/video0 only on a system without them.
        fourcc: Pixel format, such as "MJPG".
        exposure_ms: Exposure, if not automatic.
        white_balance_k: Colour temperature, if not automatic.
        gain: Gain in the camera's own unit.
        led: Red, green and blue of a DIGIT, each 0 to 15.
        keep: Number of buffered frames.
        warmup_s: Time after opening in which frames are dropped (automatic exposure, first black frames).
        timeout_s: Longest wait for a frame.
        frozen_s: Duration of equal frames after which the stream is opened again; they are stale long before.
    """

    device: str
    width: Annotated[int, Meta(ge=1, le=20_000)] | None = None
    height: Annotated[int, Meta(ge=1, le=20_000)] | None = None
    fps: Annotated[float, Meta(gt=0, le=1000)] | None = None
    fourcc: Annotated[str, Meta(pattern="^[ -~]{4}$")] | None = None
    auto_exposure: bool = False
    exposure_ms: NonNegative | None = None
    auto_white_balance: bool = False
    white_balance_k: NonNegative | None = None
    gain: NonNegative | None = None
    led: tuple[_Level, _Level, _Level] | None = None
    keep: Annotated[int, Meta(ge=1, le=1000)] = 4
    warmup_s: Annotated[float, Meta(ge=0, le=MAX_CAMERA_WAIT_S)] = 1.0
    timeout_s: Annotated[float, Meta(ge=1e-3, le=MAX_CAMERA_WAIT_S)] = 3.0
    frozen_s: Annotated[float, Meta(ge=1e-3, le=MAX_CAMERA_WAIT_S)] = 2.0

    def __post_init__(self) -> None:
        """Raise RobotConfigError for a setting out of range, or for two that exclude each other."""
        super().__post_init__()
        if (self.width is None) != (self.height is None):
            raise RobotConfigError(f"a camera's width and height must be given together, got {self.width, self.height}")
        for name, is_automatic in (("exposure_ms", self.auto_exposure), ("white_balance_k", self.auto_white_balance)):
            if is_automatic and getattr(self, name) is not None:
                raise RobotConfigError(f"a camera's {name} must be left out if it is automatic")


@dataclass(frozen=True)
class _Property:
    """One setting: its OpenCV number, conversions to and from the camera's value, and the accepted deviation."""

    number: int
    to_camera: Callable[[Any], float] = float
    from_camera: Callable[[float], Any] = float
    slack: float = 0.0

    def is_applied(self, requested: Any, actual: Any) -> bool:
        """Return whether the camera has applied the requested value."""
        if isinstance(requested, str | bool | Sequence):
            return bool(actual == (list(requested) if isinstance(requested, tuple) else requested))
        return actual is not None and abs(float(actual) - float(requested)) <= self.slack


_PROPERTIES: Mapping[str, _Property] = {
    "fourcc": _Property(
        cv2.CAP_PROP_FOURCC,
        lambda text: float(int.from_bytes(text.encode("ascii"), "little")),
        lambda number: (int(number) & 0xFFFFFFFF).to_bytes(4, "little").decode("latin-1"),
    ),
    "width": _Property(cv2.CAP_PROP_FRAME_WIDTH, from_camera=round),
    "height": _Property(cv2.CAP_PROP_FRAME_HEIGHT, from_camera=round),
    "fps": _Property(cv2.CAP_PROP_FPS, slack=0.5),
    "auto_exposure": _Property(cv2.CAP_PROP_AUTO_EXPOSURE, lambda on: 3.0 if on else 1.0, lambda value: value != 1),
    "exposure_ms": _Property(cv2.CAP_PROP_EXPOSURE, lambda ms: 10.0 * ms, lambda value: value / 10, slack=0.05),
    "auto_white_balance": _Property(cv2.CAP_PROP_AUTO_WB, from_camera=bool),
    "white_balance_k": _Property(cv2.CAP_PROP_WB_TEMPERATURE, slack=50.0),
    "gain": _Property(cv2.CAP_PROP_GAIN, slack=0.5),
    "led": _Property(
        cv2.CAP_PROP_ZOOM,
        lambda led: float(led[0] << 8 | led[1] << 4 | led[2]),
        lambda value: [int(value) >> shift & 15 for shift in (8, 4, 0)],
    ),
}
"""Settings in order of writing. The zoom control of a DIGIT sets the brightness of its LEDs."""


class CaptureStream:
    """One opened camera.

    Attributes:
        settings: Settings read back after all were written.
        refused: Settings that the camera refused, each with the requested and the actual value.
    """

    def __init__(self, device: str, settings: UsbCameraSettings, clock: Clock) -> None:
        """Open and set up the camera at the path `device`; raise DeviceError if this fails."""
        self.device, self.clock = device, clock
        self.refused: dict[str, str] = {}
        self._damaged = 0
        with self._errors():
            self._capture = open_capture(device)
        try:
            if not self._capture.isOpened():
                raise DeviceError(f"{device} cannot be opened; is it used by another program? Do you have permission?")
            with self._errors():
                self.settings = self._write(settings)
        except BaseException:
            self.close()
            raise

    def next(self) -> Frame:
        """Return the next frame, (H, W, 3) uint8 BGR; raise DeviceError if the stream has ended."""
        while True:
            with self._errors():
                grabbed, time_s = self._capture.grab(), self.clock()
                stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                if _STAMP_S[0] <= time_s - stamp_s <= _STAMP_S[1]:  # it is on the rig's clock
                    time_s = stamp_s
                complete, pixels = self._capture.retrieve() if grabbed else (False, None)
            if complete and pixels is not None and pixels.size:
                self._damaged = 0
                return Frame(pixels, time_s)
            self._damaged += 1
            if not grabbed or self._damaged > _DAMAGED_IN_A_ROW:
                raise DeviceError(f"{self.device} returned no more pictures")

    def close(self) -> None:
        """Release the camera; a second call does nothing."""
        with contextlib.suppress(cv2.error):
            self._capture.release()

    def _write(self, settings: UsbCameraSettings) -> dict[str, Any]:
        requested = {name: value for name in _PROPERTIES if (value := getattr(settings, name)) is not None}
        for name, value in requested.items():
            self._capture.set(_PROPERTIES[name].number, _PROPERTIES[name].to_camera(value))
        actual = {
            name: self._read(setting) for name, setting in _PROPERTIES.items() if name != "led" or name in requested
        }
        for name, value in requested.items():
            if not _PROPERTIES[name].is_applied(value, actual[name]):
                reported = "no such setting" if actual[name] is None else _format_value(actual[name])
                self.refused[name] = f"requested {_format_value(value)}, has {reported}"
        return actual

    def _read(self, setting: _Property) -> Any:
        value = self._capture.get(setting.number)
        return None if value == -1 or not math.isfinite(value) else setting.from_camera(value)

    @contextlib.contextmanager
    def _errors(self) -> Any:
        try:
            yield
        except cv2.error as error:
            raise DeviceError(f"{self.device}: OpenCV failed: {error.err or error}") from error


def _format_value(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def open_capture(device: str) -> Any:
    """Return OpenCV's capture of the camera at a path, resolved now, because the number behind a name may change."""
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")  # in seconds
    if not Path(device).exists():
        raise DeviceError(f"{device} does not exist; is the camera plugged in?{_connected_cameras()}")
    return cv2.VideoCapture(os.path.realpath(device), cv2.CAP_V4L2)


def stable_path(device: str) -> str:
    """Return the path of a `device` of a rig's file; raise RobotConfigError if the system has a stable one instead."""
    known = _connected_cameras()
    if not os.path.isabs(device):
        raise RobotConfigError(f"a camera must be named by its absolute path, got {device!r}.{known}")
    if known and _NUMBERED.fullmatch(os.path.normpath(device)):
        raise RobotConfigError(
            "a camera must be named by a stable path in /dev/v4l/by-id, "
            f"got {device!r}, a number that another camera may have after a restart.{known}"
        )
    return device


def _connected_cameras() -> str:
    names = discover.camera_names(discover.DEV)
    return f" Connected: {', '.join(names)}" if names else ""


class FrameReader:
    """Reads streams, each opened with `open_stream`, in a thread of its own, from `start` to `close`.

    `lost_count` is the number of failures of the stream, failed reopenings included.
    """

    def __init__(
        self,
        name: str,
        open_stream: Callable[[], CaptureStream],
        settings: UsbCameraSettings,
        *,
        clock: Clock = time.monotonic,
    ) -> None:
        self.name, self.settings, self.clock = name, settings, clock
        self.lost_count = 0
        self._open_stream = open_stream
        self._frames: deque[Frame] = deque(maxlen=settings.keep)
        self._changed = threading.Condition()
        self._stopped, self._reopen = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._last: Frame | None = None
        self._warm_s = 0.0
        self._last_error = "no frame arrived"

    def start(self) -> None:
        """Open the stream and wait for its first frame; after a DeviceError or OSError, call `close`."""
        stream = self._open()
        self._thread = threading.Thread(target=self._run, args=(stream,), name=f"frames of {self.name}", daemon=True)
        self._thread.start()
        self._wait(self.settings.timeout_s + self.settings.warmup_s)

    def newest(self) -> Frame:
        """Return the newest frame; wait for it after a loss of the stream, or raise DeviceError after `timeout_s`."""
        return self._wait(self.settings.timeout_s)[-1]

    def after(self, time_s: float, timeout_s: float) -> Frame:
        """Wait at most `timeout_s` for a frame newer than `time_s` and return the newest; else raise DeviceError."""
        return self._wait(timeout_s, time_s)[-1]

    def near(self, time_s: float) -> Frame:
        """Return the buffered frame nearest to `time_s`, on a tie the newer one; raise DeviceError without frames."""
        return min(self._wait(self.settings.timeout_s), key=lambda frame: (abs(frame.time_s - time_s), -frame.time_s))

    def recover(self) -> None:
        """Open a lost stream without further delay and wait for a frame."""
        self._reopen.set()
        self.after(self.clock(), self.settings.timeout_s + self.settings.warmup_s)  # it warms up again

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

    def _open(self) -> CaptureStream:
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

    def _run(self, stream: CaptureStream | None) -> None:
        shortest, longest = BACKOFF_S
        delay = shortest
        while not self._stopped.is_set():
            try:
                stream = stream or self._open()
                self._store(stream.next())
                delay = shortest
            except Exception as error:  # the thread must survive, and readers get the reason
                with self._changed:
                    self._frames.clear()
                    self._last_error = str(error) or type(error).__name__
                    self.lost_count += 1
                log.warning("%s: %s; reopening in %.2g s (loss %d)", self.name, error, delay, self.lost_count)
                if stream is not None:
                    stream.close()
                stream = None
                self._reopen.wait(delay)
                self._reopen.clear()
                delay = min(2 * delay, longest)
        if stream is not None:
            stream.close()

    def _store(self, frame: Frame) -> None:
        """Buffer a new frame; drop a repeat of the last frame, whose time stays unchanged."""
        with self._changed:
            if self._last is not None and np.array_equal(self._last.pixels, frame.pixels):
                if (still_s := frame.time_s - self._last.time_s) > self.settings.frozen_s:
                    raise DeviceError(f"its stream is frozen: the same picture for {still_s:.1f} s")
                return
            self._last = frame
            if frame.time_s >= self._warm_s:
                self._frames.append(frame)
                self._changed.notify_all()
