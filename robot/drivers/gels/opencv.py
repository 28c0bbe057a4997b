"""Gel sensors that are USB cameras: GelSight, GelSight Mini, DIGIT, and any other.

A new sensor is a class of a few lines here. What a PRESET says, a rig's file may say otherwise.
Automatic exposure and white balance are switched off unless asked for: with them the same press looks different twice.
"""

import time
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from robot.devices import Clock, TactileSensor
from robot.drivers.video.opencv_stream import CaptureReader, CaptureSettings, UsbCameraSettings
from robot.drivers.video.rectify import CropSettings, make_rectifier, to_rgb
from robot.readings import Frame


@dataclass(frozen=True, kw_only=True)
class GelCameraSettings(UsbCameraSettings, CropSettings):
    """The camera behind a gel, and what is cut out of its pictures. keep: pictures kept to match the other finger's in
    time.
    """


class OpencvTactile(TactileSensor):
    """The gel behind a USB camera; its keywords are those of GelCameraSettings.

    PRESET: what a kind of sensor is set to where the rig's file says nothing. CROP: what is cut off then.
    QUARTER_TURNS: of its picture, to the left.
    """

    Settings = GelCameraSettings
    PRESET: ClassVar[CaptureSettings] = CaptureSettings()
    CROP: ClassVar[tuple[float, ...]] = ()
    QUARTER_TURNS: ClassVar[int] = 0

    def __init__(self, *, finger: str, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Raises RobotConfigError for a setting out of range or a calibration file that is none; touches no device."""
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
        """Pictures taken since it was connected; their number over a while is the rate."""
        return self._reader.frame_count

    @property
    def lost_count(self) -> int:
        """How often the stream was lost and opened again since it was connected."""
        return self._reader.lost_count

    def _connect(self) -> None:
        self._reader = CaptureReader(self, self._options)
        self._reader.start()
        height, width = self._read().pixels.shape[:2]  # a calibration for another size is found here
        self._picture_px = [width, height]

    def _close(self) -> None:
        self._reader.close()

    def _settings(self) -> dict[str, Any]:
        """As the camera had them when its stream was opened last."""
        return {**self._reader.camera, "picture_px": self._picture_px}

    def _recover(self) -> None:
        self._reader.recover()

    def _read(self) -> Frame:
        return self._picture(self._reader.newest())

    def _read_near(self, time_s: float) -> Frame:
        return self._picture(self._reader.near(time_s))

    def _picture(self, frame: Frame) -> Frame:
        """Turned, the gel alone, and then in RGB: the fewer pixels, the sooner."""
        turns = self.QUARTER_TURNS
        turned = np.ascontiguousarray(np.rot90(frame.pixels, turns)) if turns else frame.pixels
        return Frame(to_rgb(self._rectifier.apply(turned)), frame.time_s)


class GelSight(OpencvTactile):
    """The paper's GelSight, as its authors ran usb_cam, with both automatics off."""

    PRESET = CaptureSettings(width=1280, height=960, fps=30.0, fourcc="MJPG")


class GelSightMini(OpencvTactile):
    """GelSight Mini: the size that the maker's software asks for, and the border that it cuts off. The camera's own
    3280 x 2464 pixels at 25 pictures a second keep a core busy.
    """

    PRESET = CaptureSettings(width=320, height=240, fps=25.0)
    CROP = (0.15, 0.15, 0.15, 0.15)


class Digit(OpencvTactile):
    """DIGIT, LEDs at full brightness unless `led` says otherwise. Its picture is transposed and turned over before
    people see it, which is a quarter turn to the left.
    """

    PRESET = CaptureSettings(width=320, height=240, fps=60.0, led=(15, 15, 15))
    QUARTER_TURNS = 1
