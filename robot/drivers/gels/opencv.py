"""Gel sensors with a USB camera: GelSight, GelSight Mini, DIGIT, and any other.

To support another sensor, add a class of a few lines here, and its name to DRIVERS of robot.real_rig. A rig's file may
override each value of PRESET. Automatic exposure and white balance are off by default, because they change the images
of equal presses.
"""

import time
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from robot.devices import Clock, TactileSensor
from robot.drivers.video.frames import Arrival
from robot.drivers.video.opencv_stream import CaptureReader, CaptureSettings, UsbCameraSettings
from robot.drivers.video.rectify import CropSettings, make_rectifier, to_rgb
from robot.readings import Frame


@dataclass(frozen=True, kw_only=True)
class GelCameraSettings(UsbCameraSettings, CropSettings):
    """Settings of the camera behind a gel and of the crop.

    `keep` frames are buffered, so that a frame close in time to that of the other finger is found.
    """


class OpencvTactile(TactileSensor):
    """The gel behind a USB camera; the fields of GelCameraSettings are keyword arguments of the constructor.

    Attributes:
        PRESET: Default width, height, fps, fourcc and led of a kind of sensor; its other fields have no effect.
        CROP: Default crop: fractions of width and height to remove at left, top, right and bottom.
        QUARTER_TURNS: Rotation of the picture, in quarter turns counterclockwise.
    """

    Settings = GelCameraSettings
    PRESET: ClassVar[CaptureSettings] = CaptureSettings()
    CROP: ClassVar[tuple[float, ...]] = ()
    QUARTER_TURNS: ClassVar[int] = 0

    def __init__(self, *, finger: str, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Check settings and calibration file without using the device; raise RobotConfigError if invalid."""
        super().__init__(f"gel {finger}", finger, clock=clock)
        options, preset = GelCameraSettings(**settings), self.PRESET
        size = options if options.width or options.height else preset
        self._options = replace(
            options,
            width=size.width,
            height=size.height,
            fps=options.fps or preset.fps,
            fourcc=options.fourcc or preset.fourcc,
            led=options.led or preset.led,
        )
        self._rectifier = make_rectifier(options, self.CROP)
        self._reader = CaptureReader(self, self._options)
        self._picture_px: list[int] = []

    @property
    def frame_count(self) -> int:
        """Number of frames since the sensor was connected."""
        return self._reader.frame_count

    @property
    def lost_count(self) -> int:
        """Failures of the stream since the sensor was connected, failed reopenings included."""
        return self._reader.lost_count

    def read_after(self, time_s: float, timeout_s: float) -> Frame:
        """Wait at most `timeout_s` for a frame newer than `time_s` and return the newest frame; else raise DeviceError.

        Unlike `read`, it waits for a lost stream no longer than this. With `timeout_s` 0 it does not wait at all.
        """
        with self._use("cannot be read"):
            return self._picture(self._reader.after(time_s, timeout_s))

    @property
    def arrivals(self) -> list[Arrival]:
        """The newest frames of the stream, as they arrived."""
        return self._reader.arrivals

    def _connect(self) -> None:
        self._reader = CaptureReader(self, self._options)
        self._reader.start()
        height, width = self._read().pixels.shape[:2]  # raises for a calibration of another size
        self._picture_px = [width, height]

    def _close(self) -> None:
        self._reader.close()

    def _settings(self) -> dict[str, Any]:
        """Return the camera's settings of the last opening of its stream."""
        return {**self._reader.camera, "picture_px": self._picture_px}

    def _recover(self) -> None:
        self._reader.recover()

    def _read(self) -> Frame:
        return self._picture(self._reader.newest())

    def _read_near(self, time_s: float) -> Frame:
        return self._picture(self._reader.near(time_s))

    def _picture(self, frame: Frame) -> Frame:
        """Rotate, crop, then convert to RGB. The conversion is last, because it is faster with fewer pixels."""
        turns = self.QUARTER_TURNS
        turned = np.ascontiguousarray(np.rot90(frame.pixels, turns)) if turns else frame.pixels
        return Frame(to_rgb(self._rectifier.apply(turned)), frame.time_s)


class GelSight(OpencvTactile):
    """The paper's GelSight, with the picture size, rate and format of the authors' usb_cam settings."""

    PRESET = CaptureSettings(width=1280, height=960, fps=30.0, fourcc="MJPG")


class GelSightMini(OpencvTactile):
    """GelSight Mini with the size and the crop of the vendor's software.

    The camera's full 3280 x 2464 pixels at 25 frames/s would occupy one CPU core.
    """

    PRESET = CaptureSettings(width=320, height=240, fps=25.0)
    CROP = (0.15, 0.15, 0.15, 0.15)


class Digit(OpencvTactile):
    """DIGIT, with LEDs at full brightness by default.

    The vendor's software transposes and flips its picture, which is a quarter turn counterclockwise.
    """

    PRESET = CaptureSettings(width=320, height=240, fps=60.0, led=(15, 15, 15))
    QUARTER_TURNS = 1
