"""Gel sensors that are USB cameras: GelSight, GelSight Mini, DIGIT, and any other.

A new sensor is a row of PRESETS and a class of three lines. What a preset says, a rig's file may say otherwise.
Automatic exposure and white balance are switched off unless asked for: with them the same press looks different twice.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from robot.devices import Clock, TactileSensor
from robot.drivers.video.frames import ReaderSettings
from robot.drivers.video.opencv_stream import LEAVE, CaptureSettings, reader_maker
from robot.drivers.video.rectify import in_rgb, make_rectifier
from robot.readings import Frame


@dataclass(frozen=True)
class Preset:
    """What a kind of sensor is set to where the rig's file says nothing. quarter_turns: to the left."""

    width: int = 0
    height: int = 0
    fps: float = 0.0
    fourcc: str = ""
    led: tuple[int, ...] = ()
    quarter_turns: int = 0
    crop: tuple[float, ...] = ()


PRESETS: Mapping[str, Preset] = {
    "uvc": Preset(),
    # As the paper's authors ran usb_cam, with both automatics off.
    "gelsight": Preset(1280, 960, 30.0, "MJPG"),
    # The size that the maker's software asks for, and the border that it cuts off (0.15 of each side). The camera's own
    # 3280 x 2464 pixels at 25 pictures a second keep a core busy.
    "gelsight_mini": Preset(320, 240, 25.0, crop=(0.15, 0.15, 0.15, 0.15)),
    # Its picture is transposed and turned over before people see it, which is a quarter turn to the left.
    "digit": Preset(320, 240, 60.0, led=(15, 15, 15), quarter_turns=1),
}


class OpencvTactile(TactileSensor):
    """The gel behind a USB camera, named by `device`, a path in /dev/v4l/by-id (or by-path: the socket).

    crop, calibration, output_px: see robot.drivers.video.rectify. keep: pictures kept to match the other finger's in
    time. Other settings as in CaptureSettings and ReaderSettings. allow_index: let `device` be a number or /dev/video0.
    """

    PRESET: ClassVar[str] = "uvc"

    def __init__(
        self,
        *,
        finger: str,
        device: str,
        width: int = 0,
        height: int = 0,
        fps: float = 0.0,
        fourcc: str = "",
        auto_exposure: bool = False,
        exposure_ms: float = LEAVE,
        auto_white_balance: bool = False,
        white_balance_k: float = LEAVE,
        gain: float = LEAVE,
        buffer: int = 0,
        led: Sequence[int] = (),
        crop: Sequence[float] = (),
        calibration: str = "",
        output_px: Sequence[int] = (),
        warmup_s: float = 1.0,
        timeout_s: float = 3.0,
        frozen_s: float = 2.0,
        keep: int = 4,
        allow_index: bool = False,
        clock: Clock = time.monotonic,
    ) -> None:
        """Raises RobotConfigError for a setting out of range or a calibration file that is none; touches no device."""
        super().__init__(f"gel {finger}", finger, clock=clock)
        preset = PRESETS[self.PRESET]
        size_is_left = not (width or height)
        self.device = device
        asked = CaptureSettings(
            width=preset.width if size_is_left else width,
            height=preset.height if size_is_left else height,
            fps=fps or preset.fps,
            fourcc=fourcc or preset.fourcc,
            auto_exposure=auto_exposure,
            exposure_ms=exposure_ms,
            auto_white_balance=auto_white_balance,
            white_balance_k=white_balance_k,
            gain=gain,
            buffer=buffer,
            led=tuple(led) or preset.led,
        )
        reading = ReaderSettings(keep=keep, warmup_s=warmup_s, timeout_s=timeout_s, frozen_s=frozen_s)
        self._rectifier = make_rectifier(calibration, crop, output_px, preset.crop)
        self._quarter_turns = preset.quarter_turns
        self._make_reader = reader_maker(self, device, asked, reading, allow_index=allow_index)
        self._reader = self._make_reader()
        self._picture_px: list[int] = []

    @property
    def frames_seen(self) -> int:
        """Pictures taken since it was connected; their number over a while is the rate."""
        return self._reader.frames_seen

    @property
    def lost(self) -> int:
        """How often the stream was lost and opened again since it was connected."""
        return self._reader.lost

    def _connect(self) -> None:
        self._reader = self._make_reader()
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
        turns = self._quarter_turns
        turned = np.ascontiguousarray(np.rot90(frame.pixels, turns)) if turns else frame.pixels
        return Frame(in_rgb(self._rectifier.apply(turned)), frame.time_s)


class GelSight(OpencvTactile):
    """The paper's GelSight: 1280 x 960 at 30 pictures a second."""

    PRESET = "gelsight"


class GelSightMini(OpencvTactile):
    """GelSight Mini: its border cut off."""

    PRESET = "gelsight_mini"


class Digit(OpencvTactile):
    """DIGIT: 320 x 240 at 60 pictures a second, upright, LEDs at full brightness unless `led` says otherwise."""

    PRESET = "digit"
