"""Views of a photo for the matcher: the whole photo, and crops around the object.

    whole   the photo, resized to a square
    crop    a square around the object, a little larger than it
    zoom    a square of 83 mm around the object's middle
    grey    the zoom without its colours

At the towers' resolution, the relief that touches a gel is a few pixels wide in a photo. `zoom` shows it larger, and
at one scale, since a gel shows the pitch of a relief in millimetres: where the field of the photo is unknown, it is
taken to be that of the simulated rig. `grey` drops the colour, which carries no tactile information.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from retrieval.data.object_finder import INPUT_PX, FoundObject, crop_square
from retrieval.data.resize import RgbImage, Samples, resize, to_float

_CROP_MARGIN = 1.12
_ZOOM_MM = 83.125
FIELD_MM = 190.0
"""Field of a photo, in millimetres along its shorter side at the object's distance, where it is unknown."""


def _crop(image: Samples, found: FoundObject, field_mm: float) -> Samples:
    return crop_square(image, found, _CROP_MARGIN * found.side)


def _zoom(image: Samples, found: FoundObject, field_mm: float) -> Samples:
    return crop_square(image, found, _ZOOM_MM / field_mm * min(image.shape[:2]))


def _grey(image: Samples, found: FoundObject, field_mm: float) -> Samples:
    grey: RgbImage = to_float(_zoom(image, found, field_mm)).mean(axis=2, keepdims=True)
    return grey


VIEWS: dict[str, Callable[[Samples, FoundObject, float], Samples]] = {
    "whole": lambda image, found, field_mm: image,
    "crop": _crop,
    "zoom": _zoom,
    "grey": _grey,
}
"""Name of a view -> function of a photo (H, W, 3), its object and its field; returns (h, w, 3), or (h, w, 1)."""


OVERSAMPLING = 2
"""Pixels of a reduced photo, along a side, for each pixel of a tower's input."""


def min_photo_side(names: Sequence[str], px: int, field_mm: float) -> int:
    """Return the smallest shorter side in pixels of a photo that is sufficient for these views and the object search.

    The view `crop` is not considered, since it depends on the object (`min_photo_side_for_crop`).
    """
    zooms = {"zoom", "grey"}.intersection(names)
    return math.ceil(max(INPUT_PX, OVERSAMPLING * px, OVERSAMPLING * px * field_mm / _ZOOM_MM if zooms else 0))


def min_photo_side_for_crop(found: FoundObject, short: int, px: int) -> int:
    """Return the side that is sufficient for the view `crop`, from the object at the shorter side `short`."""
    return math.ceil(OVERSAMPLING * px * short / (_CROP_MARGIN * max(found.side, 1)))


def tile_views(
    image: Samples, names: Sequence[str], px: int, found: FoundObject, field_mm: float = FIELD_MM
) -> RgbImage:
    """Return the views of a photo (H, W, 3) with this object, side by side: (px, len(names) * px, 3)."""
    tiles = np.empty((px, len(names) * px, 3), np.float32)
    for number, name in enumerate(names):
        tiles[:, number * px : (number + 1) * px] = resize(VIEWS[name](image, found, field_mm), (px, px))
    return tiles
