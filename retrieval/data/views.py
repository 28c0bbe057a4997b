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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from retrieval.data.resize import RgbImage, resize

_CROP_MARGIN = 1.12
_ZOOM_SHARE = 7 / 16
_SIDE = 128
"""The object is looked for in a photo of so many pixels a side."""
_RING = 6
_GAMMA = 2.2
_SHADE_TINT = 0.22
"""By how much light of the sky alone may shift the ground's colour between red and blue."""
_DARKEST_SHADE = -1.6
"""Logarithm of how dark a shadow makes the ground at most."""
_DIFFERS = (4.0, 3.5)
"""From how many deviations of the ground a colour, and a lightness, is another thing's."""

Grey = NDArray[np.float32]


class Box(NamedTuple):
    """A rectangle of a photo, in its pixels; right and bottom lie outside."""

    left: float
    top: float
    right: float
    bottom: float


def find_object(image: RgbImage) -> Box:
    """Where the one object of a photo (H, W, 3) lies that stands before a plain ground; the whole photo if none does.

    The ground is what the photo's border shows: planes of colour and lightness, fitted without what sticks out. An
    object differs from it in colour, or is lighter, or darker than a shadow: a shadow is the ground with less light
    and a tint between the lamp's and the sky's. Where depth was recorded it would say better; a catalogue has none.
    """
    import cv2  # a query of a touch needs none

    height, width = image.shape[:2]
    linear = np.clip(resize(image, (_SIDE, _SIDE)), 0, 1) ** np.float32(_GAMMA) + np.float32(1e-3)
    lightness = linear.mean(axis=2)
    colour, logarithm = linear / lightness[..., None], np.log(lightness)
    off = [_off_the_ground(colour[..., channel]) for channel in range(3)]
    lighter, spread = _off_the_ground(logarithm)
    tint = np.array([1, 0, -1], np.float32) / np.float32(np.sqrt(2))
    shift = np.stack([values for values, _ in off], axis=2)
    along = shift @ tint
    free = np.float32(_SHADE_TINT) * np.clip((-lighter - 0.1) / 0.3, 0, 1)
    shift += (np.sign(along) * np.maximum(np.abs(along) - free, 0) - along)[..., None] * tint
    by_colour = np.linalg.norm(shift, axis=2) / (np.mean([noise for _, noise in off]) + 0.02)
    by_light = np.maximum(lighter, _DARKEST_SHADE - lighter) / (spread + 0.05)
    differs = np.maximum(by_colour / _DIFFERS[0], by_light / _DIFFERS[1]).astype(np.float32)
    found = _largest_thing(cv2.GaussianBlur(differs, (0, 0), 1.0) > 1)
    if found is None:
        return Box(0, 0, width, height)
    left, top, right, bottom = (side / _SIDE for side in found)
    return Box(left * width, top * height, right * width, bottom * height)


def _off_the_ground(values: Grey) -> tuple[Grey, float]:
    """By how much values (S, S) lie above a plane through those of the border, and how much these scatter about it."""
    side = len(values)
    ring = np.ones((side, side), bool)
    ring[_RING:-_RING, _RING:-_RING] = False
    y, x = np.mgrid[:side, :side].astype(np.float32) / side - 0.5
    plane = np.stack([np.ones_like(x), x, y], axis=2)
    kept, off, scatter = ring, values, 0.0
    for _ in range(4):
        weights = np.linalg.lstsq(plane[kept], values[kept], rcond=None)[0]
        off = values - plane @ weights
        scatter = 1.4826 * float(np.median(np.abs(off[kept]))) + 1e-4  # the deviation of a normal distribution
        kept = ring & (np.abs(off) < 3 * scatter)
    return off, scatter


def _largest_thing(differs: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """Sides of the box around the largest region near the middle, with those a tenth as large; None for too little."""
    import cv2

    mask = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    count, labels, about, middles = cv2.connectedComponentsWithStats(mask)
    if count < 2:
        return None
    away = middles[1:] / len(differs) - [0.5, 0.55]
    weight = about[1:, cv2.CC_STAT_AREA] * np.exp(-(away**2).sum(axis=1) / 0.08)
    rows, columns = np.nonzero(np.isin(labels, 1 + np.flatnonzero(weight >= 0.1 * weight.max())))
    if len(rows) < 0.002 * differs.size:
        return None
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def square(image: RgbImage, box: Box, side: float) -> RgbImage:
    """The square of `side` pixels about the middle of a box; beyond the photo's edge its last pixels go on."""
    size = max(round(side), 1)
    left, top = (round(middle - size / 2) for middle in ((box.left + box.right) / 2, (box.top + box.bottom) / 2))
    height, width = image.shape[:2]
    rows = np.clip(np.arange(top, top + size), 0, height - 1)
    columns = np.clip(np.arange(left, left + size), 0, width - 1)
    return image[rows[:, None], columns]


def _crop(image: RgbImage, box: Box) -> RgbImage:
    return square(image, box, _CROP_MARGIN * max(box.right - box.left, box.bottom - box.top))


def _zoom(image: RgbImage, box: Box) -> RgbImage:
    return square(image, box, _ZOOM_SHARE * min(image.shape[:2]))


def _grey(image: RgbImage, box: Box) -> RgbImage:
    return np.repeat(_zoom(image, box).mean(axis=2, keepdims=True), 3, axis=2)


VIEWS: dict[str, Callable[[RgbImage, Box], RgbImage]] = {
    "whole": lambda image, box: image,
    "crop": _crop,
    "zoom": _zoom,
    "grey": _grey,
}
"""Name of a view -> what cuts it out of a photo (H, W, 3), given the object's box."""


OVERSAMPLED = 2
"""Pixels of a reduced photo, along a side, for each that a tower sees."""
_SHARES = {"whole": 1.0, "zoom": _ZOOM_SHARE, "grey": _ZOOM_SHARE}


def least_side(names: Sequence[str], px: int) -> int:
    """How many pixels the shorter side of a photo must have so that these views of it hold OVERSAMPLED of its pixels
    for each of theirs, whatever it shows, and its object can be looked for."""
    wanted = [OVERSAMPLED * px / _SHARES[name] for name in names if name in _SHARES]
    return math.ceil(max([_SIDE, OVERSAMPLED * px, *wanted]))


def least_side_of_crop(box: Box, short: int, px: int) -> int:
    """The same for the view that is cut to the object in `box`, of a photo whose shorter side has `short` pixels."""
    share = _CROP_MARGIN * max(box.right - box.left, box.bottom - box.top, 1) / short
    return math.ceil(OVERSAMPLED * px / float(share))


def strip(image: RgbImage, names: Sequence[str], px: int, box: Box | None = None) -> RgbImage:
    """(px, len(names) * px, 3): the views of a photo (H, W, 3), side by side. box: of its object; None looks for it."""
    if box is None:
        box = Box(0, 0, 0, 0) if set(names) == {"whole"} else find_object(image)
    return np.concatenate([resize(VIEWS[name](image, box), (px, px)) for name in names], axis=1)
