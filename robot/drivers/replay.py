"""Films and folders of pictures as gel sensors, and pictures with depth as a camera: to repeat, rehearse and test.

A sensor counts its pictures by the clock, from when it was connected: picture n is the newest from n / fps on. Below
MIN_RATE_HZ pictures a second each is shown several times, each time as a new one, as a camera would see it on a screen:
else a slow film would be a sensor whose pictures are too old. Nothing runs between two reads. A camera goes one picture
further each time it is read, however long that takes.
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
"""So often a sensor shows a picture at least: 0.1 s is well below the age at which one is refused."""

_FPS = (0.01, 1000.0)
INTRINSICS_FILE, DEPTH_SUFFIX = "intrinsics.json", "_depth.png"


@dataclass(frozen=True, kw_only=True)
class VideoSettings(CropSettings):
    """path: the film or folder. fps: pictures a second, 0 for the file's own. loop: again and again."""

    path: str
    fps: float = 0.0
    loop: bool = True

    def __post_init__(self) -> None:
        """Raises RobotConfigError for a setting out of range."""
        super().__post_init__()
        if self.fps != 0 and not _FPS[0] <= self.fps <= _FPS[1]:
            raise RobotConfigError(f"fps must be from {_FPS[0]:g} to {_FPS[1]:g}, or 0 for the file's, got {self.fps}")


@dataclass(frozen=True, kw_only=True)
class ImageFolderSettings(VideoSettings):
    """A folder of pictures does not know their rate."""

    fps: float = 30.0


class _ReplaySensor(TactileSensor):
    """Shows picture n of `_count` from n / fps seconds after connecting, again from the start where it loops.

    `_repeats`: how often each is shown, at the `_rate_hz` that comes of it.
    """

    Settings: ClassVar[type[VideoSettings]] = VideoSettings

    def __init__(self, *, finger: str, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Raises RobotConfigError for a setting out of range; opens nothing."""
        super().__init__(f"gel {finger}", finger, clock=clock)
        options = self._options = self.Settings(**settings)
        self.path, self.fps = Path(options.path), options.fps
        self._rectifier = make_rectifier(options)
        self._count, self._start_s = 0, 0.0
        self._repeats, self._rate_hz = 1, options.fps
        self._cache: OrderedDict[int, npt.NDArray[np.uint8]] = OrderedDict()

    @abstractmethod
    def _open(self) -> tuple[int, float]:
        """Return the number of pictures and their rate, 0 where unknown. Raises DeviceError or OSError."""

    @abstractmethod
    def _decode(self, number: int) -> npt.NDArray[np.uint8]:
        """Picture `number`, BGR. Raises DeviceError."""

    def _connect(self) -> None:
        self._count, rate = self._open()
        self.fps = self._options.fps or rate
        if self._count < 1 or not _FPS[0] <= self.fps <= _FPS[1]:
            raise DeviceError(
                f"{self.path} must hold pictures and say how many a second, got {self._count}, {rate:g}; if only the "
                "rate is wrong, set fps"
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
        """How many pictures were shown before the one of now, repeated ones counted each time."""
        shown = math.floor((self.clock() - self._start_s) * self._rate_hz)
        if shown >= self._count * self._repeats and not self._options.loop:
            raise DeviceError(
                f"{self.path} ended: its {self._count} pictures lasted {self._count / self.fps:.3g} s; "
                "set loop = true to see it again and again"
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
    """A film file as a sensor; its keywords are those of VideoSettings."""

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
        """Open it again: looking for a picture by number lands beside it in many kinds of film."""
        if self._video is not None:
            self._video.release()
        if not self.path.is_file():
            raise DeviceError(f"film {self.path} must be there, but is not")
        self._video, self._next = cv2.VideoCapture(str(self.path)), 0
        if not self._video.isOpened():
            raise DeviceError(f"film {self.path} cannot be opened; OpenCV must know its format")

    def _decode(self, number: int) -> npt.NDArray[np.uint8]:
        if number < self._next:
            self._rewind()
        while self._next < number and self._video.grab():
            self._next += 1
        whole, pixels = self._video.read()
        if not whole or self._next != number:
            raise DeviceError(f"film {self.path} must have {self._count} pictures, it ends after {self._next}")
        self._next += 1
        return np.asarray(pixels, dtype=np.uint8)


class ImageFolderSensor(_ReplaySensor):
    """The pictures of a folder as a sensor, in the order of their names; its keywords are those of ImageFolderSettings."""

    Settings = ImageFolderSettings
    _files: Sequence[Path] = ()

    def _open(self) -> tuple[int, float]:
        self._files = [each for each in _visible_files(self.path) if each.suffix.lower() in _SUFFIXES]
        return len(self._files), 0.0

    def _decode(self, number: int) -> npt.NDArray[np.uint8]:
        return _pixels(self._files[number], cv2.IMREAD_COLOR)


@dataclass(frozen=True)
class _ImagePair:
    """Files of one picture of a camera."""

    colour: Path
    depth: Path | None


class ReplayCamera(Camera):
    """Pictures with depth from a folder, the next one at each read, from the first again after the last.

    The folder is a recording of this project, or holds NAME.jpg (or .png) with NAME_depth.png, 16-bit in mm with 0
    where unknown, and intrinsics.json: {"fx": ..., "fy": ..., "cx": ..., "cy": ...} in pixels. A recording does not say
    them: give fx, fy, cx and cy here, which also count before the file's.
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
        """Raises RobotConfigError for fx, fy, cx and cy that are not all given, or out of range; opens nothing."""
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
        """Have the next read give picture `number`, counted from 0; beyond the last they begin again."""
        self._next = number

    def _connect(self) -> None:
        is_recording = (self.path / INFO_FILE).is_file()
        self._pairs = _recorded_pairs(self.path) if is_recording else _named_pairs(self.path)
        if not self._pairs:
            raise DeviceError(f"{self.path} must hold pictures, NAME.jpg with NAME{DEPTH_SUFFIX}, or a recording's")
        self._intrinsics = self._given_intrinsics or _intrinsics(self.path / INTRINSICS_FILE)
        self.has_depth = all(pair.depth is not None for pair in self._pairs)
        if self.has_depth and self._intrinsics is None:
            raise DeviceError(f"{self.path} holds depth: give fx, fy, cx and cy, or write {INTRINSICS_FILE} there")
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
    """What lies there, sorted; hidden files, such as other systems put beside pictures, are left out."""
    return sorted(each for each in folder.iterdir() if not each.name.startswith("."))


def _intrinsics(path: Path) -> Intrinsics | None:
    if not path.is_file():
        return None
    try:
        return build(Intrinsics, parse_object(path.read_bytes(), RobotConfigError))
    except (RobotConfigError, DeviceError) as error:
        raise DeviceError(f"{path} must hold fx, fy, cx and cy in pixels, and nothing else: {error}") from error


def _depth_m(path: Path) -> npt.NDArray[np.float32]:
    depth_mm = _pixels(path, cv2.IMREAD_UNCHANGED)
    if depth_mm.dtype != np.uint16 or depth_mm.ndim != 2:
        raise DeviceError(f"{path} must be 16-bit grey, in mm, got {depth_mm.shape} {depth_mm.dtype}")
    return np.where(depth_mm > 0, depth_mm * np.float32(1e-3), np.float32(np.nan)).astype(np.float32)


def _pixels(path: Path, flags: int) -> npt.NDArray[Any]:
    if not path.is_file():  # to read from a pipe, say, might never end
        raise DeviceError(f"{path} must be a picture, but is no file")
    pixels = decode_picture(path.read_bytes(), flags)
    if pixels is None:
        raise DeviceError(f"{path} must be a picture, but cannot be decoded")
    return pixels
