"""Views of a photo for the matcher: the whole photo, and crops around the object.

    whole   the photo, resized to a square
    crop    a square around the object, a little larger than it
    zoom    a square around the object's middle, 7/16 of the photo's shorter side: one scale for all photos of a camera
    grey    the zoom without its colours

At the towers' resolution, the relief that touches a gel is a few pixels wide in a photo. `zoom` shows it at the
camera's resolution. `grey` drops the colour, which carries no tactile information.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from retrieval.data.resize import RgbImage, Samples, resize, to_float

_CROP_MARGIN = 1.12
_ZOOM_FRACTION = 7 / 16
_SIDE = 128
"""Side in pixels of the resized photo in which the object is searched."""
_RING = 6
_GAMMA = 2.2
_SHADE_TINT = 0.22
"""Largest shift of the ground's colour between red and blue if only diffuse light reaches it."""
_DARKEST_SHADE = -1.6
"""Logarithm of the darkest shadow's lightness relative to the ground."""
_DIFFERENCE_THRESHOLDS = (4.0, 3.5)
"""Deviations from the ground's colour, and from its lightness, above which a pixel belongs to the object."""

Grey = NDArray[np.float32]


class PixelBox(NamedTuple):
    """A rectangle of a photo, in its pixels; right and bottom lie outside."""

    left: float
    top: float
    right: float
    bottom: float


def find_object(image: Samples) -> PixelBox:
    """Return the box of the object on a plain background in a photo (H, W, 3), or of the whole photo if none is found.

    The border of the photo shows this background (the ground): planes of colour and lightness, fitted robustly. An
    object differs from it in colour, or is lighter, or darker than a shadow. A shadow is the ground with less light,
    and with a tint between those of the lamp and of diffuse light (the sky). Depth would be more reliable, but a
    catalogue has none.
    """
    height, width = image.shape[:2]
    linear = np.clip(resize(image, (_SIDE, _SIDE)), 0, 1) ** np.float32(_GAMMA) + np.float32(1e-3)
    channels = np.ascontiguousarray(linear.transpose(2, 0, 1))  # channels first: sums take a tenth of the time
    lightness = _channel_sum(channels) / 3
    (red, green, blue, lighter), scatter = _ground_residuals(np.stack([*(channels / lightness), np.log(lightness)]))
    tint = (red - blue) / np.float32(np.sqrt(2))
    free = np.float32(_SHADE_TINT) * np.clip((-lighter - np.float32(0.1)) / np.float32(0.3), 0, 1)
    shift = (np.copysign(np.maximum(np.abs(tint) - free, 0), tint) - tint) / np.float32(np.sqrt(2))
    by_colour = np.sqrt(_channel_sum(np.square([red + shift, green, blue - shift]))) / float(scatter[:3].mean() + 0.02)
    by_light = np.maximum(lighter, _DARKEST_SHADE - lighter) / float(scatter[3] + 0.05)
    differs = np.maximum(by_colour / _DIFFERENCE_THRESHOLDS[0], by_light / _DIFFERENCE_THRESHOLDS[1])
    found = _largest_region(cv2.GaussianBlur(differs, (0, 0), 1.0) > 1)
    if found is None:
        return PixelBox(0, 0, width, height)
    left, top, right, bottom = (side / _SIDE for side in found)
    return PixelBox(left * width, top * height, right * width, bottom * height)


def _channel_sum(channels: NDArray[np.float32]) -> Grey:
    """Return the sum of three channels, in the same order as numpy's sum over a pixel, in a tenth of its time."""
    total: Grey = channels[0] + channels[1] + channels[2]
    return total


def _ground_residuals(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the residuals (n, S, S) of n maps above a plane fitted to their border, and the border's scatter (n,)."""
    ring, planes, products = _border()
    flat = values.reshape(len(values), -1)
    border, terms = flat[:, ring], planes[:, ring]
    weights, scatter = np.zeros((len(values), 3)), np.zeros(len(values))
    inliers = np.ones(border.shape, bool)
    for _ in range(4):
        chosen = inliers.astype(np.float64)
        normal, right = (chosen @ products).reshape(-1, 3, 3), (chosen * border) @ terms.T
        weights[:] = np.linalg.solve(normal, right[..., None])[..., 0]
        residuals = np.abs(border - (weights @ terms).astype(np.float32))
        medians = np.nanmedian(np.where(inliers, residuals.astype(np.float64), np.nan), axis=1)
        scatter = 1.4826 * medians + 1e-4  # standard deviation of a normal distribution
        inliers = residuals < 3 * scatter[:, None]
    return values - (weights @ planes).astype(np.float32).reshape(values.shape), scatter


@lru_cache(maxsize=1)
def _border() -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the border's pixels (R,), the planes 1, x and y (3, S * S), and their products (R, 9) at the border."""
    inside = np.zeros((_SIDE, _SIDE), bool)
    inside[_RING:-_RING, _RING:-_RING] = True
    ring = np.flatnonzero(~inside)
    y, x = np.mgrid[:_SIDE, :_SIDE].reshape(2, -1) / _SIDE - 0.5
    planes = np.stack([np.ones_like(x), x, y])
    terms = planes[:, ring].T
    return ring, planes, (terms[:, :, None] * terms[:, None, :]).reshape(-1, 9)


def _largest_region(differs: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """Return the box around the object's regions; None if they are too small.

    The weight of a region is its area times a factor that falls with its distance from about the middle of the photo.
    The object's regions have at least a tenth of the largest weight.
    """
    mask = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    count, _, about, middles = cv2.connectedComponentsWithStats(mask)
    if count < 2:
        return None
    away = middles[1:] / len(differs) - [0.5, 0.55]
    weight = about[1:, cv2.CC_STAT_AREA] * np.exp(-(away**2).sum(axis=1) / 0.08)
    left, top, width, height, area = about[1:][weight >= 0.1 * weight.max()].T
    if area.sum() < 0.002 * differs.size:
        return None
    return left.min(), top.min(), (left + width).max(), (top + height).max()


def crop_square(image: Samples, box: PixelBox, side: float) -> Samples:
    """Return the square of `side` pixels around the middle of a box; pixels beyond the photo's edge repeat the edge."""
    size = max(round(side), 1)
    left, top = (round(middle - size / 2) for middle in ((box.left + box.right) / 2, (box.top + box.bottom) / 2))
    inside = image[max(top, 0) : top + size, max(left, 0) : left + size]
    above, before = max(-top, 0), max(-left, 0)
    beyond = above, size - above - inside.shape[0], before, size - before - inside.shape[1]
    whole: Samples = cv2.copyMakeBorder(inside, *beyond, cv2.BORDER_REPLICATE) if any(beyond) else inside
    return whole


def _zoom(image: Samples, box: PixelBox) -> Samples:
    return crop_square(image, box, _ZOOM_FRACTION * min(image.shape[:2]))


def _grey(image: Samples, box: PixelBox) -> Samples:
    grey: RgbImage = _channel_sum(to_float(_zoom(image, box)).transpose(2, 0, 1))[..., None] / np.float32(3)
    return grey


VIEWS: dict[str, Callable[[Samples, PixelBox], Samples]] = {
    "whole": lambda image, box: image,
    "crop": lambda image, box: crop_square(image, box, _CROP_MARGIN * max(box.right - box.left, box.bottom - box.top)),
    "zoom": _zoom,
    "grey": _grey,
}
"""Name of a view -> function of a photo (H, W, 3) and the object's box; returns (h, w, 3), or (h, w, 1) without
colour."""


OVERSAMPLING = 2
"""Pixels of a reduced photo, along a side, for each pixel of a tower's input."""
_VIEW_FRACTIONS = {"whole": 1.0, "zoom": _ZOOM_FRACTION, "grey": _ZOOM_FRACTION}


def min_photo_side(names: Sequence[str], px: int) -> int:
    """Return the smallest shorter side in pixels of a photo that is sufficient for these views and the object search.

    The view `crop` is not considered, since it depends on the object (`min_photo_side_for_crop`).
    """
    sides = [OVERSAMPLING * px / _VIEW_FRACTIONS[name] for name in names if name in _VIEW_FRACTIONS]
    return math.ceil(max([_SIDE, OVERSAMPLING * px, *sides]))


def min_photo_side_for_crop(box: PixelBox, short: int, px: int) -> int:
    """Return the side that is sufficient for the view `crop`, from the object's box at the shorter side `short`."""
    fraction = _CROP_MARGIN * max(box.right - box.left, box.bottom - box.top, 1) / short
    return math.ceil(OVERSAMPLING * px / float(fraction))


def tile_views(image: Samples, names: Sequence[str], px: int, box: PixelBox | None = None) -> RgbImage:
    """Return the views of a photo (H, W, 3), side by side: (px, len(names) * px, 3).

    The object's box is searched for if it is None and a view needs it.
    """
    if box is None:
        box = PixelBox(0, 0, 0, 0) if set(names) == {"whole"} else find_object(image)
    tiles = np.empty((px, len(names) * px, 3), np.float32)
    for number, name in enumerate(names):
        tiles[:, number * px : (number + 1) * px] = resize(VIEWS[name](image, box), (px, px))
    return tiles
