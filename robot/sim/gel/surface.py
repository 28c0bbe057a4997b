"""The deformed surface of a gel, as the optics sees it: slopes at every image pixel, heights where asked.

Axes of the image: x to the right, y down, z from the gel towards the camera, the origin in the middle of the
field. A gel that is pressed inwards by u rises towards the camera: z = u(x, y), and its normal is
n = (-du/dx, -du/dy, 1) / sqrt(1 + |grad u|^2).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot.errors import RobotConfigError, SceneError

Array = NDArray[np.float32]

# The camera looks straight down: beyond a slope of 1000 (89.94 degrees) a facet shows nothing but its edge, and
# the square of 1000 is far from float32's end. What is deeper than a metre is no gel.
MAX_SLOPE = 1e3
_MAX_DEPTH_MM = 1e3


@dataclass(frozen=True)
class Field:
    """The part of the gel that the camera sees: rows x cols square pixels of `pixel_mm`.

    Raises RobotConfigError for no pixels, or pixels of no size.
    """

    rows: int = 240
    cols: int = 320
    pixel_mm: float = 0.0634

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1 or self.rows * self.cols > 1 << 26:
            raise RobotConfigError(f"a gel image must have 1 to 2^26 pixels, got {self.rows} x {self.cols}")
        if not 0 < self.pixel_mm < np.inf:
            raise RobotConfigError(f"pixel_mm must be a length above 0, got {self.pixel_mm}")

    @property
    def size_mm(self) -> tuple[float, float]:
        """(height, width) of the field."""
        return self.rows * self.pixel_mm, self.cols * self.pixel_mm

    def positions(self) -> tuple[Array, Array]:
        """X (1, cols) and y (rows, 1) of the pixels' middles from the middle of the field, in mm."""
        return _positions(self)

    def unit_positions(self) -> tuple[Array, Array]:
        """The positions as shares of half the field's width and height: -1 to 1."""
        x, y = self.positions()
        height, width = self.size_mm
        return x * np.float32(2 / width), y * np.float32(2 / height)


@lru_cache(maxsize=16)
def _positions(field: Field) -> tuple[Array, Array]:
    x = (np.arange(field.cols) - (field.cols - 1) / 2) * field.pixel_mm
    y = (np.arange(field.rows) - (field.rows - 1) / 2) * field.pixel_mm
    return x.astype(np.float32)[None, :], y.astype(np.float32)[:, None]


class Surface:
    """The surface over a field, from a displacement map on any grid that covers the same field.

    `slope_x`, `slope_y` are (rows, cols) float32: central differences on the map's own grid, then interpolated
    (cubic) or averaged to the pixels; interpolating the heights first would leave ripples of the grid's pitch.
    Raises SceneError for a map that is not two-dimensional, is empty, or is not finite.
    """

    def __init__(self, displacement_mm: NDArray[Any], field: Field) -> None:
        self.field = field
        self.displacement_mm = _validate_displacement(displacement_mm)

    @cached_property
    def slopes(self) -> tuple[Array, Array]:
        """du/dx and du/dy at the pixels, each (rows, cols)."""
        height, width = self.field.size_mm
        rows, cols = self.displacement_mm.shape
        down, right = _differences(self.displacement_mm)
        return self._at_pixels(right / np.float32(width / cols)), self._at_pixels(down / np.float32(height / rows))

    def coarse(self, step: int) -> Array:
        """Displacement in mm on a grid `step` times coarser than the image, at least 1 x 1."""
        shape = (max(1, self.field.rows // step), max(1, self.field.cols // step))
        return resized(self.displacement_mm, shape)

    def _at_pixels(self, slope: Array) -> Array:
        return np.clip(resized(slope, (self.field.rows, self.field.cols)), -MAX_SLOPE, MAX_SLOPE)


def resized(image: Array, shape: tuple[int, int]) -> Array:
    """The image on a grid of `shape` over the same field: averaged when it has fewer points, else cubic."""
    if image.shape[:2] == shape:
        return image
    finer = image.shape[0] > shape[0] or image.shape[1] > shape[1]
    out: Array = cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA if finer else cv2.INTER_CUBIC)
    return out


def _differences(heights: Array) -> tuple[Array, Array]:
    """Differences down and to the right, per grid step: central, one-sided at the edges, 0 along one point."""
    out = []
    for axis in (0, 1):
        many = heights.shape[axis] > 1
        out.append(np.gradient(heights, axis=axis) if many else np.zeros_like(heights))
    return out[0], out[1]


def _validate_displacement(displacement_mm: NDArray[Any]) -> Array:
    given = np.asarray(displacement_mm)
    if given.ndim != 2 or given.size == 0 or given.dtype.kind not in "fiu":
        raise SceneError(
            f"displacement_mm must be a (rows, cols) map of numbers, got {given.dtype} of shape {given.shape}; "
            "give Contact.displacement_mm"
        )
    if not np.isfinite(given).all():
        count = int((~np.isfinite(given)).sum())
        raise SceneError(
            f"displacement_mm must be finite, got {count} values of {given.size} that are not; see Contact.flags"
        )
    return np.asarray(np.clip(given, -_MAX_DEPTH_MM, _MAX_DEPTH_MM), np.float32)
