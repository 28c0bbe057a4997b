"""What of a photo the matcher sees: the whole, and the object cut out of it.

    whole   the photo, its sides made equal
    crop    a square around the object, a little larger than it
    zoom    a square around the object's middle, 7/16 of the photo's shorter side: one scale for all photos of a camera
    grey    the zoom without its colours

In a photo at the towers' resolution the relief that a gel feels is a few pixels wide. `zoom` shows it at the camera's
own resolution; `grey` because colour says nothing about what can be felt.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from retrieval.data.resize import RgbImage, Samples, resize_unchecked, to_unit

_CROP_MARGIN = 1.12
_ZOOM_FRACTION = 7 / 16
_SIDE = 128
"""The object is looked for in a photo of so many pixels a side."""
_RING = 6
_GAMMA = 2.2
_SHADE_TINT = 0.22
"""By how much light of the sky alone may shift the ground's colour between red and blue."""
_DARKEST_SHADE = -1.6
"""Logarithm of how dark a shadow makes the ground at most."""
_DIFFERENCE_THRESHOLDS = (4.0, 3.5)
"""From how many deviations of the ground a colour, and a lightness, is another thing's."""

Grey = NDArray[np.float32]


class PixelBox(NamedTuple):
    """A rectangle of a photo, in its pixels; right and bottom lie outside."""

    left: float
    top: float
    right: float
    bottom: float


def find_object(image: Samples) -> PixelBox:
    """Where the one object of a photo (H, W, 3) lies that stands before a plain ground; the whole photo if none does.

    The ground is what the photo's border shows: planes of colour and lightness, fitted without what sticks out. An
    object differs from it in colour, or is lighter, or darker than a shadow: a shadow is the ground with less light
    and a tint between the lamp's and the sky's. Where depth was recorded it would say better; a catalogue has none.
    """
    height, width = image.shape[:2]
    linear = np.clip(resize_unchecked(image, (_SIDE, _SIDE)), 0, 1) ** np.float32(_GAMMA) + np.float32(1e-3)
    channels = np.ascontiguousarray(linear.transpose(2, 0, 1))  # a plane after the other: sums in a tenth of the time
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
    """The sum of three channels, one added after the other as numpy's own sum over a pixel's numbers does, in a tenth
    of its time.
    """
    total: Grey = channels[0] + channels[1] + channels[2]
    return total


def _ground_residuals(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """How much each of n maps of values (n, S, S) lies above a plane through the values of its border, and how much
    these scatter about that plane (n,).
    """
    ring, planes, products = _border()
    flat = values.reshape(len(values), -1)
    border, terms = flat[:, ring], planes[:, ring]
    weights, scatter = np.zeros((len(values), 3)), np.zeros(len(values))
    kept = np.ones(border.shape, bool)
    for _ in range(4):
        chosen = kept.astype(np.float64)
        normal, right = (chosen @ products).reshape(-1, 3, 3), (chosen * border) @ terms.T
        weights[:] = np.linalg.solve(normal, right[..., None])[..., 0]
        away = np.abs(border - (weights @ terms).astype(np.float32))
        scatter = 1.4826 * _medians(away, kept) + 1e-4  # the deviation of a normal distribution
        kept = away < 3 * scatter[:, None]
    return values - (weights @ planes).astype(np.float32).reshape(values.shape), scatter


@lru_cache(maxsize=1)
def _border() -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """The places (R,) of the border's pixels; the planes 1, x and y of all pixels (3, S * S); and of the border's the
    products of any two (R, 9).
    """
    inside = np.zeros((_SIDE, _SIDE), bool)
    inside[_RING:-_RING, _RING:-_RING] = True
    ring = np.flatnonzero(~inside)
    y, x = np.mgrid[:_SIDE, :_SIDE].reshape(2, -1) / _SIDE - 0.5
    planes = np.stack([np.ones_like(x), x, y])
    terms = planes[:, ring].T
    return ring, planes, (terms[:, :, None] * terms[:, None, :]).reshape(-1, 9)


def _medians(values: NDArray[np.float32], kept: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The median (n,) of the kept values of each row of `values` (n, R); each row keeps one at least."""
    ranked = np.sort(np.where(kept, values, np.float32(np.inf)), axis=1)
    count, rows = kept.sum(axis=1), np.arange(len(values))
    middle: NDArray[np.float64] = (ranked[rows, (count - 1) // 2].astype(np.float64) + ranked[rows, count // 2]) / 2
    return middle


def _largest_region(differs: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """Sides of the box around the largest region near the middle, with those a tenth as large; None for too little."""
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
    """The square of `side` pixels about the middle of a box in the photo; beyond the photo's edge its last pixels go
    on.
    """
    size = max(round(side), 1)
    left, top = (round(middle - size / 2) for middle in ((box.left + box.right) / 2, (box.top + box.bottom) / 2))
    inside = image[max(top, 0) : top + size, max(left, 0) : left + size]
    above, before = max(-top, 0), max(-left, 0)
    beyond = above, size - above - inside.shape[0], before, size - before - inside.shape[1]
    whole: Samples = cv2.copyMakeBorder(inside, *beyond, cv2.BORDER_REPLICATE) if any(beyond) else inside
    return whole


def _crop(image: Samples, box: PixelBox) -> Samples:
    return crop_square(image, box, _CROP_MARGIN * max(box.right - box.left, box.bottom - box.top))


def _zoom(image: Samples, box: PixelBox) -> Samples:
    return crop_square(image, box, _ZOOM_FRACTION * min(image.shape[:2]))


def _grey(image: Samples, box: PixelBox) -> Samples:
    grey: RgbImage = _channel_sum(to_unit(_zoom(image, box)).transpose(2, 0, 1))[..., None] / np.float32(3)
    return grey


VIEWS: dict[str, Callable[[Samples, PixelBox], Samples]] = {
    "whole": lambda image, box: image,
    "crop": _crop,
    "zoom": _zoom,
    "grey": _grey,
}
"""Name of a view -> what cuts it out of a photo (H, W, 3), given the object's box: (h, w, 3), or (h, w, 1) of no
colour."""


OVERSAMPLING = 2
"""Pixels of a reduced photo, along a side, for each that a tower sees."""
_VIEW_FRACTIONS = {"whole": 1.0, "zoom": _ZOOM_FRACTION, "grey": _ZOOM_FRACTION}


def min_photo_side(names: Sequence[str], px: int) -> int:
    """How many pixels the shorter side of a photo must have so that these views of it hold OVERSAMPLING of its pixels
    for each of theirs, whatever it shows, and its object can be looked for.
    """
    wanted = [OVERSAMPLING * px / _VIEW_FRACTIONS[name] for name in names if name in _VIEW_FRACTIONS]
    return math.ceil(max([_SIDE, OVERSAMPLING * px, *wanted]))


def min_photo_side_for_crop(box: PixelBox, short: int, px: int) -> int:
    """The same for the view that is cut to the object in `box`, of a photo whose shorter side has `short` pixels."""
    share = _CROP_MARGIN * max(box.right - box.left, box.bottom - box.top, 1) / short
    return math.ceil(OVERSAMPLING * px / float(share))


def tile_views(image: Samples, names: Sequence[str], px: int, box: PixelBox | None = None) -> RgbImage:
    """(px, len(names) * px, 3): the views of a photo (H, W, 3), side by side. box: of its object; None looks for it."""
    if box is None:
        box = PixelBox(0, 0, 0, 0) if set(names) == {"whole"} else find_object(image)
    found = np.empty((px, len(names) * px, 3), np.float32)
    for place, name in enumerate(names):
        found[:, place * px : (place + 1) * px] = resize_unchecked(VIEWS[name](image, box), (px, px))
    return found
