"""Faults of a photo that make its object harder to recognise, for a warning when an index is built."""

import math

from retrieval.data.object_finder import FoundObject
from retrieval.data.resize import Samples
from retrieval.data.sharpening import BLURRED_PX

NO_OBJECT, SMALL, CUT_OFF, BLURRED = FAULTS = ("no object found", "small", "cut off", "blurred")
SMALLEST_SIDE_PX = 48
"""Smallest root of an object's visible area."""


def photo_faults(photo: Samples, found: FoundObject, blur_px: float) -> tuple[str, ...]:
    """Return the faults (of `FAULTS`) of a photo (H, W, 3) with this object and this blur (`sharpening.blur_px`)."""
    height, width = photo.shape[:2]
    if found.area >= height * width:
        return (NO_OBJECT,)
    edges = found.left, found.top, width - found.right, height - found.bottom
    faults = {
        SMALL: math.sqrt(found.area) < SMALLEST_SIDE_PX,
        CUT_OFF: min(edges) < 0.01 * min(height, width),
        BLURRED: blur_px >= BLURRED_PX,
    }
    return tuple(name for name, has_fault in faults.items() if has_fault)
