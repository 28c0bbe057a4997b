"""Rectification of a camera's picture to the gel: crop the border or straighten four corners, then resize.

A calibration file is JSON with image_px and either corners_px or crop:

    {
      "image_px": [1280, 960],
      "corners_px": [[102, 80], [1190, 95], [1170, 900], [120, 890]],
      "output_px": [640, 480]
    }

    image_px    width and height of the calibrated pictures; other sizes raise an error
    corners_px  the gel's corners in the displayed picture: top left, top right, bottom right, bottom left; integers are
                centres of pixels. They become the corner pixels of the result
    crop        fractions of the picture to remove: left, top, right, bottom, each from 0 to below 1
    output_px   width and height of the result; left out: the size of the remaining picture
    note        free text
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from robot.errors import DeviceError, RobotConfigError
from robot.settings import TypedSettings, build
from robot.storage import parse_object, read_content

Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class CropSettings(TypedSettings):
    """How a sensor's pictures are cropped to the gel.

    Attributes:
        crop: Fractions to remove at left, top, right and bottom.
        calibration: A calibration file, instead of `crop`.
        output_px: Width and height of the result; overrides the file's.
    """

    crop: tuple[float, ...] = ()
    calibration: str = ""
    output_px: tuple[int, ...] = ()


_MAX_PX = 20_000


@dataclass(frozen=True)
class Rectifier(TypedSettings):
    """Rectification of a picture; by default none. `crop` and `corners_px` exclude each other."""

    crop: tuple[float, ...] = ()
    corners_px: tuple[tuple[float, float], ...] = ()
    image_px: tuple[int, ...] = ()
    output_px: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Raise RobotConfigError for invalid numbers."""
        super().__post_init__()
        if self.crop and self.corners_px:
            raise RobotConfigError("crop and corners_px exclude each other; give one of them")
        for name in ("image_px", "output_px"):
            size = getattr(self, name)
            if size and (len(size) != 2 or not all(1 <= each <= _MAX_PX for each in size)):
                raise RobotConfigError(f"{name} must be width and height, 1 to {_MAX_PX} pixels, got {list(size)}")
        if self.crop:
            _check_crop(self.crop)
        if self.corners_px:
            _check_corners(self.corners_px, self.image_px)

    def apply(self, picture: Picture) -> Picture:
        """Rectify a picture (H, W, 3) uint8; raise DeviceError for one of another kind or size."""
        check_colours(picture)
        size = (picture.shape[1], picture.shape[0])
        if self.image_px and size != self.image_px:
            raise DeviceError(
                f"a picture must be {_format_size(self.image_px)} pixels, as in the calibration file, got "
                f"{_format_size(size)}; set that width and height, or calibrate again"
            )
        if not self.corners_px:
            return _resize(self._crop(picture), self.output_px)
        size, matrix = self._map
        straight = np.asarray(cv2.warpPerspective(picture, matrix, size, flags=cv2.INTER_LINEAR), dtype=np.uint8)
        return _resize(straight, self.output_px)

    def _crop(self, picture: Picture) -> Picture:
        if not self.crop:
            return picture
        height, width = picture.shape[:2]
        left, top, right, bottom = self.crop
        x, y = round(left * width), round(top * height)
        return picture[y : max(y + 1, height - round(bottom * height)), x : max(x + 1, width - round(right * width))]

    @cached_property
    def _map(self) -> tuple[tuple[int, int], npt.NDArray[np.float64]]:
        """Size of the result (mean lengths of opposite sides, which keeps the sharpness), and the (3, 3) map to it."""
        corners = np.array(self.corners_px, np.float32)
        top, right, bottom, left = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        width, height = round(float(top + bottom) / 2) + 1, round(float(left + right) / 2) + 1
        target = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], np.float32)
        return (width, height), cv2.getPerspectiveTransform(corners, target)


def _resize(picture: Picture, size: tuple[int, ...]) -> Picture:
    """Resize, by area means to shrink (without aliasing of the gel's markers), by interpolation to enlarge."""
    if not size or size == (picture.shape[1], picture.shape[0]):
        return np.ascontiguousarray(picture)
    shrinks = size[0] <= picture.shape[1] and size[1] <= picture.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, size, interpolation=method), dtype=np.uint8)


def check_colours(picture: npt.NDArray[Any]) -> None:
    """Raise DeviceError unless the picture is (H, W, 3) uint8."""
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8 or not picture.size:
        raise DeviceError(
            f"a camera must return pictures H x W x 3 uint8, got {picture.shape} {picture.dtype}; set a fourcc with "
            'colours, such as "MJPG"'
        )


def to_rgb(picture: Picture) -> Picture:
    """Convert BGR to contiguous RGB; raise DeviceError unless the picture has three colours.

    It takes 0.1 ms for 896 x 672 pixels; reversing the axis and copying takes 6 ms.
    """
    check_colours(picture)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def make_rectifier(settings: CropSettings, default_crop: Sequence[float] = ()) -> Rectifier:
    """Build the rectifier of a driver's settings; raise RobotConfigError for both a calibration file and `crop`."""
    size = tuple(settings.output_px)
    if not settings.calibration:
        return Rectifier(crop=tuple(settings.crop or default_crop), output_px=size)
    if settings.crop:
        raise RobotConfigError("crop and a calibration file exclude each other; give one of them")
    found = load_rectifier(settings.calibration)
    return Rectifier(found.crop, found.corners_px, found.image_px, size or found.output_px)


def load_rectifier(path: str | Path) -> Rectifier:
    """Read a calibration file; raise RobotConfigError with its name if it is invalid."""
    data = read_content(path, RobotConfigError)
    try:
        found = parse_object(data, RobotConfigError)
        if not found.get("image_px") or ("crop" in found) == ("corners_px" in found):
            raise RobotConfigError("it must contain image_px, and either corners_px or crop")
        return build(Rectifier, {name: value for name, value in found.items() if name != "note"})
    except RobotConfigError as error:
        raise RobotConfigError(f"calibration file {path}: {error}") from error


def _check_crop(crop: tuple[float, ...]) -> None:
    if len(crop) != 4 or not all(0 <= each < 1 for each in crop) or crop[0] + crop[2] >= 1 or crop[1] + crop[3] >= 1:
        raise RobotConfigError(
            f"crop must be fractions at left, top, right and bottom that leave a part of the picture, got {list(crop)}"
        )


def _check_corners(corners: tuple[tuple[float, float], ...], image_px: tuple[int, ...]) -> None:
    """Raise RobotConfigError unless the corners are clockwise (y down), convex and inside the picture."""
    points = np.array(corners, dtype=np.float64)
    if points.shape != (4, 2) or not np.isfinite(points).all():
        raise RobotConfigError(f"corners_px must be four points x, y, got {list(corners)}")
    sides = np.roll(points, -1, axis=0) - points
    after = np.roll(sides, -1, axis=0)
    if not (sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0] > 0).all():
        raise RobotConfigError(
            f"corners_px must be top left, top right, bottom right, bottom left of a convex shape, got {list(corners)}"
        )
    if not image_px or not ((points >= -0.5) & (points <= np.array(image_px) - 0.5)).all():
        raise RobotConfigError(f"corners_px must lie inside image_px {list(image_px)}, got {list(corners)}")


def _format_size(size: Sequence[int]) -> str:
    return " x ".join(map(str, size))
