"""Faults of a photo that make its object harder to recognise, for a warning when an index is built."""

import math

import cv2
import numpy as np

from retrieval.data.object_finder import FoundObject
from retrieval.data.resize import Samples, resize

NO_OBJECT, SMALL, CUT_OFF, BLURRED = FAULTS = ("no object found", "small", "cut off", "blurred")
SMALLEST_SIDE_PX = 48
"""Smallest root of an object's visible area."""
LARGEST_RATIO = 0.62
"""Largest ratio of the steepest slopes after and before a blur of 1.5 pixels: 0.35 for a sharp edge, and
s / sqrt(s^2 + 1.5^2) for one that is blurred by s pixels."""
_BLUR_PX, _STEEPEST, _MARGIN = 1.5, 99.5, 0.05
_VIEW_PX = 160
"""Side of the picture of the object in which slopes are measured, about that of a view: finer detail is not used."""


def photo_faults(photo: Samples, found: FoundObject) -> tuple[str, ...]:
    """Return the faults (of `FAULTS`) of a photo (H, W, 3) with this object."""
    height, width = photo.shape[:2]
    if found.area >= height * width:
        return (NO_OBJECT,)
    edges = found.left, found.top, width - found.right, height - found.bottom
    faults = {
        SMALL: math.sqrt(found.area) < SMALLEST_SIDE_PX,
        CUT_OFF: min(edges) < 0.01 * min(height, width),
        BLURRED: _blur_ratio(photo, found) > LARGEST_RATIO,
    }
    return tuple(name for name, has_fault in faults.items() if has_fault)


def _blur_ratio(photo: Samples, found: FoundObject) -> float:
    """Return the ratio of the steepest slopes in the object's box and about it, after a further blur and before."""
    (x, y), reach = found.middle, (0.5 + _MARGIN) * found.side
    top, left = max(int(y - reach), 0), max(int(x - reach), 0)
    inside = photo[top : math.ceil(y + reach), left : math.ceil(x + reach)]
    height, width = (min(side, _VIEW_PX) for side in inside.shape[:2])
    grey = resize(inside, (height, width)).mean(axis=2)
    slopes = []
    for picture in (grey, cv2.GaussianBlur(grey, (0, 0), _BLUR_PX)):
        across, down = cv2.Sobel(picture, cv2.CV_32F, 1, 0), cv2.Sobel(picture, cv2.CV_32F, 0, 1)
        slopes.append(float(np.percentile(np.hypot(across, down), _STEEPEST)))
    return slopes[1] / max(slopes[0], 1e-6)
