"""Replay of recorded pictures: videos and image folders as gel sensors, pictures with depth as a camera.

A sensor selects its picture by the clock: picture n is the newest from n / fps seconds after connecting. Below
MIN_RATE_HZ pictures/s, each picture is shown several times as a new frame, because frames of a slow video would be
rejected as stale. Nothing runs between two reads. A camera advances by one picture with each read.
"""

import math
import time
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import numpy.typing as npt

from robot.devices import Camera, Clock, TactileSensor
from robot.drivers.video.rectify import CropSettings, make_rectifier, to_rgb
from robot.errors import DeviceError, RecordingError, RobotConfigError
from robot.readings import RGBD, Frame, Intrinsics
from robot.recording.folder import INFO_FILE, read_recording
from robot.settings import build
from robot.storage import decode_picture, parse_object

_CACHE_SIZE = 8
_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")
MIN_RATE_HZ = 10.0
"""Lowest frame rate of a replay sensor; 0.1 s is well below the age at which a frame is stale."""

_FPS = (0.01, 1000.0)
INTRINSICS_FILE, DEPTH_SUFFIX = "intrinsics.json", "_depth.png"


@dataclass(frozen=True, kw_only=True)
class VideoSettings(CropSettings):
    """Settings of a video.

    Attributes:
        path: The video or folder.
        fps: Pictures/s; 0 for the file's own rate.
        loop: Whether to start again at the end.
    """

    path: str
    fps: float = 0.0
    loop: bool = True

    def __post_init__(self) -> None:
        """Raise RobotConfigError for a setting out of range."""
        super().__post_init__()
        if self.fps != 0 and not _FPS[0] <= self.fps <= _FPS[1]:
            raise RobotConfigError(f"fps must be from {_FPS[0]:g} to {_FPS[1]:g}, or 0 for the file's, got {self.fps}")


@dataclass(frozen=True, kw_only=True)
class ImageFolderSettings(VideoSettings):
    """Settings of an image folder, which has no rate of its own."""

    fps: float = 30.0


class _ReplaySensor(TactileSensor):
    """Base of replay sensors: shows picture n of `_count` from n / fps seconds after connecting.

    Each picture is shown `_repeats` times, at the rate `_rate_hz`.
    """

    Settings: ClassVar[type[VideoSettings]] = VideoSettings

    def __init__(self, *, finger: str, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Check the settings without opening the file; raise RobotConfigError for one out of range."""
        super().__init__(f"gel {finger}", finger, clock=clock)
        options = self._options = self.Settings(**settings)
        self.path, self.fps = Path(options.path), options.fps
        self._rectifier = make_rectifier(options)
        self._count, self._start_s = 0, 0.0
        self._repeats, self._rate_hz = 1, options.fps
        self._cache: OrderedDict[int, npt.NDArray[np.uint8]] = OrderedDict()

    @abstractmethod
    def _open(self) -> tuple[int, float]:
        """Return the number of pictures and their rate (0: unknown); raise DeviceError or OSError."""

    @abstractmethod
    def _decode(self, number: int) -> npt.NDArray[np.uint8]:
        """Return picture `number` in BGR; raise DeviceError if it cannot be decoded."""

    def _connect(self) -> None:
        self._count, rate = self._open()
        self.fps = self._options.fps or rate
        if self._count < 1 or not _FPS[0] <= self.fps <= _FPS[1]:
            raise DeviceError(
                f"{self.path} must contain pictures and have a frame rate, got {self._count} pictures at {rate:g} "
                "frames/s; if only the rate is wrong, set fps"
            )
        self._repeats = max(1, math.ceil(MIN_RATE_HZ / self.fps))
        self._rate_hz = self._repeats * self.fps
        self._picture(0)
        self._start_s = self.clock()

    def _close(self) -> None:
        self._cache.clear()

    def _settings(self) -> dict[str, Any]:
        return {"path": str(self.path), "pictures": self._count, "fps": self.fps, "loop": self._options.loop}

    def _read(self) -> Frame:
        return self._frame(self._shown_count())

    def _read_near(self, time_s: float) -> Frame:
        return self._frame(min(self._shown_count(), max(0, round((time_s - self._start_s) * self._rate_hz))))

    def _shown_count(self) -> int:
        """Return the number of frames before the current one, repetitions included."""
        shown = math.floor((self.clock() - self._start_s) * self._rate_hz)
        if shown >= self._count * self._repeats and not self._options.loop:
            raise DeviceError(
                f"{self.path} ended: its {self._count} pictures lasted {self._count / self.fps:.3g} s; "
                "set loop = true to repeat it"
            )
        return shown

    def _frame(self, shown: int) -> Frame:
        return Frame(self._picture(shown // self._repeats % self._count), self._start_s + shown / self._rate_hz)

    def _picture(self, number: int) -> npt.NDArray[np.uint8]:
        if number not in self._cache:
            self._cache[number] = to_rgb(self._rectifier.apply(self._decode(number)))
            while len(self._cache) > _CACHE_SIZE:
                self._cache.popitem(last=False)
        return self._cache[number]


class VideoSensor(_ReplaySensor):
    """A video file as a sensor; the fields of VideoSettings are keyword arguments of the constructor."""

    _video: Any = None
    _next = 0

    def _open(self) -> tuple[int, float]:
        self._rewind()
        return int(self._video.get(cv2.CAP_PROP_FRAME_COUNT)), float(self._video.get(cv2.CAP_PROP_FPS))

    def _close(self) -> None:
        super()._close()
        if self._video is not None:
            self._video.release()
            self._video = None

    def _rewind(self) -> None:
        """Open the file again, because seeking by number is inexact in many video formats."""
        if self._video is not None:
            self._video.release()
        if not self.path.is_file():
            raise DeviceError(f"video {self.path} does not exist")
        self._video, self._next = cv2.VideoCapture(str(self.path)), 0
        if not self._video.isOpened():
            raise DeviceError(f"video {self.path} cannot be opened; OpenCV must support its format")

    def _decode(self, number: int) -> npt.NDArray[np.uint8]:
        if number < self._next:
            self._rewind()
        while self._next < number and self._video.grab():
            self._next += 1
        complete, pixels = self._video.read()
        if not complete or self._next != number:
            raise DeviceError(f"video {self.path} must have {self._count} pictures, but ends after {self._next}")
        self._next += 1
        return np.asarray(pixels, dtype=np.uint8)


class ImageFolderSensor(_ReplaySensor):
    """The pictures of a folder as a sensor, ordered by name; keyword arguments as in ImageFolderSettings."""

    Settings = ImageFolderSettings
    _files: Sequence[Path] = ()

    def _open(self) -> tuple[int, float]:
        self._files = [each for each in _visible_files(self.path) if each.suffix.lower() in _SUFFIXES]
        return len(self._files), 0.0

    def _decode(self, number: int) -> npt.NDArray[np.uint8]:
        return _pixels(self._files[number], cv2.IMREAD_COLOR)


@dataclass(frozen=True)
class _ImagePair:
    """Colour file and depth file of one picture."""

    colour: Path
    depth: Path | None


class ReplayCamera(Camera):
    """A camera that returns the next picture of a folder at each read, and the first again after the last.

    The folder is a recording of this project, or contains NAME.jpg (or .png) with NAME_depth.png (16-bit in mm, 0 where
    unknown) and intrinsics.json: {"fx": ..., "fy": ..., "cx": ..., "cy": ...} in pixels. A recording has no intrinsics:
    give fx, fy, cx and cy as arguments; they override those of the file.
    """

    def __init__(
        self,
        *,
        path: str,
        extrinsics: npt.ArrayLike,
        fx: float | None = None,
        fy: float | None = None,
        cx: float | None = None,
        cy: float | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        """Check fx, fy, cx and cy, given all or none, without opening the folder; raise RobotConfigError if invalid."""
        super().__init__("replay camera", extrinsics, clock=clock)
        self.path = Path(path)
        lens = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
        given = {name: value for name, value in lens.items() if value is not None}
        try:
            self._given_intrinsics = build(Intrinsics, given) if given else None
        except (RobotConfigError, DeviceError) as error:
            raise RobotConfigError(f"fx, fy, cx and cy must be given together, in pixels: {error}") from error
        self._intrinsics: Intrinsics | None = None
        self._pairs: list[_ImagePair] = []
        self._next = 0

    def seek(self, number: int) -> None:
        """Make the next read return picture `number` from 0, modulo the number of pictures."""
        self._next = number

    def _connect(self) -> None:
        is_recording = (self.path / INFO_FILE).is_file()
        self._pairs = _recorded_pairs(self.path) if is_recording else _named_pairs(self.path)
        if not self._pairs:
            raise DeviceError(f"{self.path} must contain pictures, NAME.jpg with NAME{DEPTH_SUFFIX}, or a recording")
        self._intrinsics = self._given_intrinsics or _intrinsics(self.path / INTRINSICS_FILE)
        self.has_depth = all(pair.depth is not None for pair in self._pairs)
        if self.has_depth and self._intrinsics is None:
            raise DeviceError(f"{self.path} contains depth: give fx, fy, cx and cy, or write {INTRINSICS_FILE} there")
        self._next = 0

    def _close(self) -> None:
        self._pairs = []

    def _settings(self) -> dict[str, Any]:
        return {"path": str(self.path), "pictures": len(self._pairs), "has_depth": self.has_depth}

    def _read(self, depth: bool) -> RGBD:
        pair = self._pairs[self._next % len(self._pairs)]
        colour = to_rgb(_pixels(pair.colour, cv2.IMREAD_COLOR))
        depth_m = _depth_m(pair.depth) if depth and pair.depth is not None else None
        self._next += 1
        return RGBD(colour, depth_m, self._intrinsics, self.clock())


def _recorded_pairs(folder: Path) -> list[_ImagePair]:
    try:
        grasps = read_recording(folder).grasps
    except RecordingError as error:
        raise DeviceError(f"replay camera: {error}") from error
    return [_ImagePair(folder / grasp.photo, folder / grasp.depth if grasp.depth else None) for grasp in grasps]


def _named_pairs(folder: Path) -> list[_ImagePair]:
    files = dict.fromkeys(_visible_files(folder))
    colours = [each for each in files if each.suffix.lower() in _SUFFIXES and not each.name.endswith(DEPTH_SUFFIX)]
    depths = [each.with_name(each.stem + DEPTH_SUFFIX) for each in colours]
    return [
        _ImagePair(colour, depth if depth in files else None) for colour, depth in zip(colours, depths, strict=True)
    ]


def _visible_files(folder: Path) -> list[Path]:
    """Return the files of a folder, sorted, without hidden files."""
    return sorted(each for each in folder.iterdir() if not each.name.startswith("."))


def _intrinsics(path: Path) -> Intrinsics | None:
    if not path.is_file():
        return None
    try:
        return build(Intrinsics, parse_object(path.read_bytes(), RobotConfigError))
    except (RobotConfigError, DeviceError) as error:
        raise DeviceError(f"{path} must contain only fx, fy, cx and cy in pixels: {error}") from error


def _depth_m(path: Path) -> npt.NDArray[np.float32]:
    depth_mm = _pixels(path, cv2.IMREAD_UNCHANGED)
    if depth_mm.dtype != np.uint16 or depth_mm.ndim != 2:
        raise DeviceError(f"{path} must be 16-bit grey, in mm, got {depth_mm.shape} {depth_mm.dtype}")
    return np.where(depth_mm > 0, depth_mm * np.float32(1e-3), np.float32(np.nan)).astype(np.float32)


def _pixels(path: Path, flags: int) -> npt.NDArray[Any]:
    if not path.is_file():  # reading a pipe might never end
        raise DeviceError(f"{path} must be a picture, but is not a file")
    pixels = decode_picture(path.read_bytes(), flags)
    if pixels is None:
        raise DeviceError(f"{path} must be a picture, but cannot be decoded")
    return pixels
