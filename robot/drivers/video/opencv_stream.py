"""A camera through OpenCV and Video4Linux: writes settings, reads them back, and reads pictures with their times.

Facts used (OpenCV's cap_v4l.cpp; the kernel's uvcvideo): a change of format, size or buffers restarts the stream, so
these are set first, width directly before height. A control that a camera lacks reads -1. Automatic exposure is a
menu with 1 = manual and 3 = automatic; exposure is in units of 0.1 ms. CAP_PROP_POS_MSEC is the time at which the
picture's buffer was filled, on the clock of time.monotonic. grab() times out after OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT
seconds, 10 by default.
"""

import contextlib
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from robot.devices import Clock, Device
from robot.drivers import discover
from robot.drivers.video.frames import FrameReader, ReaderSettings
from robot.errors import DeviceError, RobotConfigError
from robot.readings import Frame
from robot.settings import TypedSettings, bounded

_GRAB_LIMIT_S = 1
_DAMAGED_IN_A_ROW = 10
"""Number of consecutive undecodable pictures that are skipped before the stream is considered lost."""

_STAMP_S = (-0.05, 1.0)
"""Accepted ages of a picture's own time stamp in s; a stamp outside this range is on another clock."""

_NUMBERED = re.compile(r"/dev/video\d+")
_ZERO_ALLOWED = ("exposure_ms", "white_balance_k", "gain")


@dataclass(frozen=True, kw_only=True)
class CaptureSettings(TypedSettings):
    """Requested settings of a camera; a setting with 0, "", () or None is not changed.

    Attributes:
        width: Width in pixels.
        height: Height in pixels.
        fps: Frames/s.
        fourcc: Pixel format, such as "MJPG".
        auto_exposure: Whether the exposure is automatic.
        exposure_ms: Exposure, if not automatic.
        auto_white_balance: Whether the white balance is automatic.
        white_balance_k: Colour temperature, if not automatic.
        gain: Gain in the camera's own unit.
        buffer: Number of pictures that the system buffers, 1 to 10.
        led: Red, green and blue of a DIGIT, each 0 to 15.
    """

    width: int = 0
    height: int = 0
    fps: float = bounded(0, 1000, 0.0)
    fourcc: str = ""
    auto_exposure: bool = False
    exposure_ms: float | None = bounded(0, 1e9, None)
    auto_white_balance: bool = False
    white_balance_k: float | None = bounded(0, 1e9, None)
    gain: float | None = bounded(0, 1e9, None)
    buffer: int = bounded(0, 10, 0, unit="pictures")
    led: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Raise RobotConfigError for a setting out of range."""
        super().__post_init__()
        size, text, led = (self.width, self.height), self.fourcc, self.led
        is_size = size == (0, 0) or 1 <= min(size) <= max(size) <= 20000
        _require("width and height must be given together, up to 20000 pixels", size, is_size)
        _require('fourcc must be four letters, such as "MJPG"', text, not text or bool(re.fullmatch(r"[ -~]{4}", text)))
        for name, automatic in (("exposure_ms", self.auto_exposure), ("white_balance_k", self.auto_white_balance)):
            value = getattr(self, name)
            _require(f"{name} must be left out if it is automatic", value, not automatic or value is None)
        _require("led must be three numbers, 0 to 15", led, len(led) in (0, 3) and all(0 <= each <= 15 for each in led))

    def requested(self) -> dict[str, Any]:
        """Return the settings to write, in order of writing."""
        values = {name: getattr(self, name) for name in _PROPERTIES}
        return {
            name: value
            for name, value in values.items()
            if value is not None and (value or isinstance(value, bool) or name in _ZERO_ALLOWED)
        }


@dataclass(frozen=True, kw_only=True)
class UsbCameraSettings(CaptureSettings, ReaderSettings):
    """Settings of a USB camera.

    Attributes:
        device: Path in /dev/v4l/by-id, or in by-path (the socket).
        allow_index: Whether `device` may be a number or a path such as /dev/video0.
    """

    device: str
    allow_index: bool = False


def _require(requirement: str, got: object, is_met: bool) -> None:
    if not is_met:
        raise RobotConfigError(f"a camera's {requirement}, got {got}")


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
    "buffer": _Property(cv2.CAP_PROP_BUFFERSIZE, from_camera=round),
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

    def __init__(self, device: str, settings: CaptureSettings, clock: Clock) -> None:
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
                grabbed = self._capture.grab()
                time_s = self._time()
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

    def _time(self) -> float:
        """Return the picture's own time stamp if it is on the rig's clock, else the current time."""
        now = self.clock()
        stamp = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        return stamp if _STAMP_S[0] <= now - stamp <= _STAMP_S[1] else now

    def _write(self, settings: CaptureSettings) -> dict[str, Any]:
        requested = settings.requested()
        for name, value in requested.items():
            self._capture.set(_PROPERTIES[name].number, _PROPERTIES[name].to_camera(value))
        actual = {name: self._read(each) for name, each in _PROPERTIES.items() if name != "led" or name in requested}
        for name, value in requested.items():
            if not _PROPERTIES[name].is_applied(value, actual[name]):
                reported = "no such setting" if actual[name] is None else _format_value(actual[name])
                self.refused[name] = f"requested {_format_value(value)}, has {reported}"
        return actual

    def _read(self, each: _Property) -> Any:
        value = self._capture.get(each.number)
        return None if value == -1 or not math.isfinite(value) else each.from_camera(value)

    @contextlib.contextmanager
    def _errors(self) -> Any:
        try:
            yield
        except cv2.error as error:
            raise DeviceError(f"{self.device}: OpenCV failed: {error.err or error}") from error


class CaptureReader(FrameReader):
    """Frame reader of one camera.

    Attributes:
        camera: Settings read back at the last opening of the stream.
        refused: The owner's dictionary of refused settings, updated at each opening.
    """

    def __init__(self, owner: Device, requested: UsbCameraSettings) -> None:
        """Check the path without opening it; raise RobotConfigError if `device` is not a stable name."""
        super().__init__(owner.name, self._open_camera, requested, clock=owner.clock)
        self.requested, self.refused = requested, owner.refused
        self._path = stable_path(requested.device, requested.allow_index)
        self.camera: dict[str, Any] = {}

    def _open_camera(self) -> CaptureStream:
        """Open the camera, then write and read back its settings; the thread calls this after each loss too."""
        stream = CaptureStream(self._path, self.requested, self.clock)
        self.refused.clear()
        self.refused.update(stream.refused)
        self.camera = {"device": self.requested.device, **stream.settings}
        return stream

    def recover(self) -> None:
        """Open a lost stream without further delay and wait for a frame."""
        self.reopen_now()
        self.after(self.clock())


def _format_value(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def open_capture(device: str) -> Any:
    """Return OpenCV's capture of the camera at a path, resolved now, because the number behind a name may change."""
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(_GRAB_LIMIT_S))
    if not Path(device).exists():
        raise DeviceError(f"{device} does not exist; is the camera plugged in?{_connected_cameras()}")
    return cv2.VideoCapture(os.path.realpath(device), cv2.CAP_V4L2)


def stable_path(device: str, allow_index: bool) -> str:
    """Return the path to open for a `device` of a rig's file.

    Args:
        device: Path, or number of the camera.
        allow_index: Whether a number or a path such as /dev/video0 is accepted.

    Raises:
        RobotConfigError: The device is not a path, or not a stable one.
    """
    path = f"/dev/video{device}" if device.isascii() and device.isdigit() else device
    if not os.path.isabs(path):
        raise RobotConfigError(f"a camera must be named by its absolute path, got {device!r}.{_connected_cameras()}")
    if allow_index or not _NUMBERED.fullmatch(os.path.normpath(path)):
        return path
    known = (
        _connected_cameras()
        or " This system has no stable names: set allow_index = true if only one camera is ever plugged in"
    )
    raise RobotConfigError(
        "a camera must be named by a stable path in /dev/v4l/by-id, "
        f"got {device!r}, a number that another camera may have after a restart.{known}"
    )


def _connected_cameras() -> str:
    names = discover.camera_names(discover.DEV)
    note = discover.shared_name_note(names)
    return f" Connected: {', '.join(names)}{note and f' ({note})'}" if names else ""
