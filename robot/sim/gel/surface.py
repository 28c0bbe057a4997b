"""The deformed surface of a gel: slopes at every image pixel, and heights on request.

Axes of the image: x to the right, y down, z from the gel towards the camera, the origin in the middle of the field. A
gel that is pressed inwards by u rises towards the camera: z = u(x, y), and its normal is n = (-du/dx, -du/dy, 1) /
sqrt(1 + |grad u|^2).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot.errors import SceneError

Array = NDArray[np.float32]

# The camera looks straight down: beyond a slope of 1000 (89.94 degrees) a facet shows only its edge, and the square
# of 1000 is far from float32's limit. No gel is deeper than a metre.
MAX_SLOPE = 1e3
_MAX_DEPTH_MM = 1e3


@dataclass(frozen=True)
class Field:
    """The part of the gel in the camera's view: rows x cols square pixels of `pixel_mm`."""

    rows: int = 240
    cols: int = 320
    pixel_mm: float = 0.0634

    @property
    def size_mm(self) -> tuple[float, float]:
        """(height, width) of the field."""
        return self.rows * self.pixel_mm, self.cols * self.pixel_mm

    def positions(self) -> tuple[Array, Array]:
        """Return x (1, cols) and y (rows, 1) of the pixel centres from the middle of the field, in mm."""
        x = (np.arange(self.cols) - (self.cols - 1) / 2) * self.pixel_mm
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pixel_mm
        return x.astype(np.float32)[None, :], y.astype(np.float32)[:, None]

    def unit_positions(self) -> tuple[Array, Array]:
        """Return the positions scaled so that the field spans -1 to 1 in width and height."""
        x, y = self.positions()
        height, width = self.size_mm
        return x * np.float32(2 / width), y * np.float32(2 / height)


class Surface:
    """The surface over a field, from a displacement map on any grid that covers the same field.

    The slopes are central differences on the map's own grid, then interpolated (cubic) or averaged to the pixels;
    interpolating the heights first would leave ripples of the grid's pitch.

    Args:
        displacement_mm: (r, c) displacement, inwards.
        field: the part of the gel in the camera's view.

    Raises:
        SceneError: The map is not finite.
    """

    def __init__(self, displacement_mm: NDArray[Any], field: Field) -> None:
        self.field = field
        if not np.isfinite(displacement_mm).all():
            raise SceneError("displacement_mm must be finite; see Contact.flags")
        self.displacement_mm: Array = np.clip(displacement_mm, -_MAX_DEPTH_MM, _MAX_DEPTH_MM).astype(np.float32)

    @cached_property
    def slopes(self) -> tuple[Array, Array]:
        """du/dx and du/dy at the pixels, each (rows, cols) float32."""
        height, width = self.field.size_mm
        rows, cols = self.displacement_mm.shape
        # Central differences, one-sided at the edges.
        down, right = (
            np.gradient(self.displacement_mm, axis=axis) if many > 1 else np.zeros_like(self.displacement_mm)
            for axis, many in enumerate((rows, cols))
        )
        return self._at_pixels(right / np.float32(width / cols)), self._at_pixels(down / np.float32(height / rows))

    def coarse(self, step: int) -> Array:
        """Return the displacement in mm on a grid `step` times coarser than the image, at least 1 x 1."""
        shape = (max(1, self.field.rows // step), max(1, self.field.cols // step))
        return resized(self.displacement_mm, shape)

    def _at_pixels(self, slope: Array) -> Array:
        return np.clip(resized(slope, (self.field.rows, self.field.cols)), -MAX_SLOPE, MAX_SLOPE)


def resized(image: Array, shape: tuple[int, int]) -> Array:
    """Resample the image to a grid of `shape` over the same field: averaged if that has fewer points, else cubic."""
    if image.shape[:2] == shape:
        return image
    finer = image.shape[0] > shape[0] or image.shape[1] > shape[1]
    return np.asarray(cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA if finer else cv2.INTER_CUBIC))
