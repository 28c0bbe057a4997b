"""A plain USB camera over the table: colour only, so grasps cannot be planned from its picture."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from robot.devices import Camera, Clock
from robot.drivers.video.frames import Arrival
from robot.drivers.video.opencv_stream import CaptureReader, UsbCameraSettings
from robot.drivers.video.rectify import to_rgb
from robot.readings import RGBD
from robot.settings import bounded


@dataclass(frozen=True, kw_only=True)
class UvcSettings(UsbCameraSettings):
    """Settings of a USB camera, with automatic exposure and white balance; upside_down: rotate by 180 degrees."""

    auto_exposure: bool = True
    auto_white_balance: bool = True
    keep: int = bounded(1, 1000, 1, unit="pictures")
    upside_down: bool = False


class UvcCamera(Camera):
    """A USB camera by its stable name; the fields of UvcSettings are keyword arguments."""

    Settings = UvcSettings
    has_depth = False

    def __init__(self, *, extrinsics: npt.ArrayLike, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Check the settings without using the device; raise RobotConfigError for one out of range."""
        super().__init__("usb camera", extrinsics, clock=clock)
        self._options = UvcSettings(**settings)
        self._reader = CaptureReader(self, self._options)

    @property
    def arrivals(self) -> list[Arrival]:
        """The newest frames of the stream, as they arrived."""
        return self._reader.arrivals

    def _connect(self) -> None:
        self._reader = CaptureReader(self, self._options)
        self._reader.start()

    def _close(self) -> None:
        self._reader.close()

    def _settings(self) -> dict[str, Any]:
        return dict(self._reader.camera)

    def _recover(self) -> None:
        self._reader.recover()

    def _read(self, depth: bool) -> RGBD:
        frame = self._reader.newest()
        colour = to_rgb(frame.pixels)
        if self._options.upside_down:
            colour = np.ascontiguousarray(colour[::-1, ::-1])
        return RGBD(colour, None, None, frame.time_s)
