"""Sensors and cameras on USB: GelSight, GelSight Mini, DIGIT, any other gel, and a plain camera over the table.

To support another gel, add a class of a few lines here, and its name to DRIVERS of robot.real_rig. A rig's file may
override each value of PRESET. Automatic exposure and white balance of a gel are off by default, because they change the
images of equal presses.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from robot.devices import Camera, Clock, Device, TactileSensor
from robot.drivers.usb_camera.stream import CaptureStream, FrameReader, UsbCameraSettings, stable_path
from robot.errors import DeviceError, RobotConfigError
from robot.readings import RGBD, Frame

Picture = npt.NDArray[np.uint8]
_Fraction = Annotated[float, Meta(ge=0, lt=1)]
_Size = Annotated[int, Meta(ge=1, le=20_000)]


class UsbDevice(Device):
    """The common part of the devices behind a USB camera: its stream."""

    _options: UsbCameraSettings
    _path: str
    _reader: FrameReader
    _camera: dict[str, Any] = {}  # noqa: RUF012

    def _open_stream(self) -> CaptureStream:
        """Open the camera, then write and read back its settings; the reader calls this after each loss too."""
        stream = CaptureStream(self._path, self._options, self.clock)
        self.refused.clear()
        self.refused.update(stream.refused)
        self._camera = {"device": self._options.device, **stream.settings}
        return stream

    def _connect(self) -> None:
        self._reader = FrameReader(self.name, self._open_stream, self._options, clock=self.clock)
        self._reader.start()

    def _close(self) -> None:
        self._reader.close()

    def _settings(self) -> dict[str, Any]:
        """Return the camera's settings of the last opening of its stream."""
        return dict(self._camera)

    def _recover(self) -> None:
        self._reader.recover()


# Gels --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class GelCameraSettings(UsbCameraSettings):
    """Settings of the camera behind a gel and of the crop.

    `keep` frames are buffered, so that a frame close in time to that of the other finger is found.

    Attributes:
        crop: Fractions of the picture to remove at left, top, right and bottom, each from 0 to below 1.
        output_px: Width and height of the result; left out: the size of the remaining picture.
    """

    crop: tuple[_Fraction, _Fraction, _Fraction, _Fraction] = (0.0, 0.0, 0.0, 0.0)
    output_px: tuple[_Size, _Size] | None = None

    def __post_init__(self) -> None:
        """Raise RobotConfigError for a setting out of range."""
        super().__post_init__()
        left, top, right, bottom = self.crop
        if left + right >= 1 or top + bottom >= 1:
            raise RobotConfigError(f"crop must leave a part of the picture, got {self.crop}")


class OpencvTactile(UsbDevice, TactileSensor):
    """The gel behind a USB camera; the fields of GelCameraSettings are keyword arguments of the constructor.

    Attributes:
        PRESET: Settings of a kind of sensor, where the rig's file has none.
        QUARTER_TURNS: Rotation of the picture, in quarter turns counterclockwise.
    """

    Settings = GelCameraSettings
    PRESET: ClassVar[Mapping[str, Any]] = {}
    QUARTER_TURNS: ClassVar[int] = 0
    _options: GelCameraSettings

    def __init__(self, *, finger: str, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Check the settings without using the device; raise RobotConfigError if invalid."""
        super().__init__(f"gel {finger}", finger, clock=clock)
        self._options = GelCameraSettings(**{**self.PRESET, **settings})
        self._path = stable_path(self._options.device)
        self._picture_px: list[int] = []

    def read_after(self, time_s: float, timeout_s: float) -> Frame:
        """Wait at most `timeout_s` for a frame newer than `time_s` and return the newest frame; else raise DeviceError.

        Unlike `read`, it waits for a lost stream no longer than this. With `timeout_s` 0 it does not wait at all.
        """
        with self._use("cannot be read"):
            return self._picture(self._reader.after(time_s, timeout_s))

    def _connect(self) -> None:
        super()._connect()
        height, width = self._read().pixels.shape[:2]
        self._picture_px = [width, height]

    def _settings(self) -> dict[str, Any]:
        return {**super()._settings(), "picture_px": self._picture_px}

    def _read(self) -> Frame:
        return self._picture(self._reader.newest())

    def _read_near(self, time_s: float) -> Frame:
        return self._picture(self._reader.near(time_s))

    def _picture(self, frame: Frame) -> Frame:
        """Rotate, crop, then convert to RGB. The conversion is last, because it is faster with fewer pixels."""
        picture = np.rot90(frame.pixels, self.QUARTER_TURNS)
        return Frame(to_rgb(crop_and_resize(picture, self._options.crop, self._options.output_px)), frame.time_s)


class GelSight(OpencvTactile):
    """The paper's GelSight, with the picture size, rate and format of the authors' usb_cam settings."""

    PRESET: ClassVar = {"width": 1280, "height": 960, "fps": 30.0, "fourcc": "MJPG"}


class GelSightMini(OpencvTactile):
    """GelSight Mini with the size and the crop of the vendor's software.

    The camera's full 3280 x 2464 pixels at 25 frames/s would occupy one CPU core.
    """

    PRESET: ClassVar = {"width": 320, "height": 240, "fps": 25.0, "crop": (0.15, 0.15, 0.15, 0.15)}


class Digit(OpencvTactile):
    """DIGIT, with LEDs at full brightness by default.

    The vendor's software transposes and flips its picture, which is a quarter turn counterclockwise.
    """

    PRESET: ClassVar = {"width": 320, "height": 240, "fps": 60.0, "led": (15, 15, 15)}
    QUARTER_TURNS = 1


def crop_and_resize(
    picture: Picture, crop: tuple[float, float, float, float], output_px: tuple[int, int] | None
) -> Picture:
    """Crop a picture (H, W, 3) and resize it, by area means to shrink (without aliasing of the gel's markers)."""
    height, width = picture.shape[:2]
    left, top, right, bottom = crop
    x, y = min(round(left * width), width - 1), min(round(top * height), height - 1)
    part = picture[y : max(y + 1, height - round(bottom * height)), x : max(x + 1, width - round(right * width))]
    part = np.ascontiguousarray(part)
    if output_px is None:
        return part
    shrinks = output_px[0] <= part.shape[1] and output_px[1] <= part.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(part, output_px, interpolation=method), dtype=np.uint8)


def to_rgb(picture: Picture) -> Picture:
    """Convert BGR to contiguous RGB; raise DeviceError unless the picture is (H, W, 3) uint8.

    It takes 0.1 ms for 896 x 672 pixels; reversing the axis and copying takes 6 ms.
    """
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise DeviceError(
            f"a camera must return pictures H x W x 3 uint8, got {picture.shape} {picture.dtype}; set a fourcc with "
            'colours, such as "MJPG"'
        )
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


# The camera of the table -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class UvcSettings(UsbCameraSettings):
    """Settings of a USB camera, with automatic exposure and white balance; upside_down: rotate by 180 degrees."""

    auto_exposure: bool = True
    auto_white_balance: bool = True
    keep: Annotated[int, Meta(ge=1, le=1000)] = 1
    upside_down: bool = False


class UvcCamera(UsbDevice, Camera):
    """A plain USB camera: colour only, so grasps cannot be planned from its picture.

    The fields of UvcSettings are keyword arguments of the constructor.
    """

    Settings = UvcSettings
    has_depth = False
    _options: UvcSettings

    def __init__(self, *, extrinsics: npt.ArrayLike, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Check the settings without using the device; raise RobotConfigError for one out of range."""
        super().__init__("usb camera", extrinsics, clock=clock)
        self._options = UvcSettings(**settings)
        self._path = stable_path(self._options.device)

    def _read(self, depth: bool) -> RGBD:
        frame = self._reader.newest()
        colour = to_rgb(frame.pixels)
        if self._options.upside_down:
            colour = np.ascontiguousarray(colour[::-1, ::-1])
        return RGBD(colour, None, None, frame.time_s)
