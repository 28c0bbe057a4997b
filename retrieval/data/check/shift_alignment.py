"""Near copies that were moved: the correlation of two pictures at the best of many shifts.

`retrieval.data.check.near_copies` compares pictures as they lie, by 16 x 16 grey levels, and loses a copy that was moved by
a few pixels. Here pictures have 128 x 128 grey levels, and the inner part of one is compared with the other at every
shift of up to a sixteenth of the side. At each shift a constant and the best multiple of the median picture of their
kind are taken off, which all of them share. The distance is 1 less the greatest correlation of what remains.

Measured with objects that differ: the nearest of 7,000 pairs lay at .145 (photos) and .136 (touches) on the simulated
rig, at .066 (photos) and .015 (touches: smooth things, pressed alike) on VT60; a picture moved by 6 pixels and encoded
again as JPEG 90 lies at .002 (photos) and .05 (touches) from its original, at most. No threshold serves all, so a copy
must be four times as near as the third nearest other object.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from retrieval.data.resize import RgbImage

PX, MAX_SHIFT_PX = 128, 8
SIDE = PX - 2 * MAX_SHIFT_PX
MIN_LIMIT, MAX_DISTANCE = 0.02, 0.1
RELATIVE_LIMIT = 0.25
_MAX_MEDIAN_PICTURES = 500
"""Pictures at most, evenly chosen, of which the median is taken."""
_HALF_PIXEL_KERNELS = ((1, 2), (2, 1), (2, 2))
_ONES = np.full((SIDE, SIDE), 1 / SIDE, np.float32)

Doubles = NDArray[np.float64]
FineGreys = NDArray[np.float16]
"""(PX, PX): grey levels of 255, each within .06."""


def fine_grey_levels(picture: NDArray[np.uint8] | RgbImage) -> FineGreys:
    """Return the grey levels (PX, PX) of a picture (H, W, 3), in the unit of its own."""
    grey = picture.mean(axis=2, dtype=np.float32)
    return np.asarray(cv2.resize(grey, (PX, PX), interpolation=cv2.INTER_AREA).astype(np.float16))


class AlignedSet:
    """Pictures of one kind, (n, PX, PX), to be compared at every shift."""

    def __init__(self, pictures: Sequence[FineGreys]) -> None:
        self._pictures = pictures
        sample = pictures[:: max(1, -(-len(pictures) // _MAX_MEDIAN_PICTURES))]
        common = np.median(np.array(sample, np.float32), axis=0) if len(sample) else np.zeros((PX, PX), np.float32)
        self._common = _unit(_inner(common) - _inner(common).mean())

    def distances(self, row: int, others: Sequence[int]) -> Doubles:
        """Return the distance of picture `row` to each of the others (n,): 0 for a copy, about 1 for unlike ones."""
        return self._distances_to(self._pictures[row].astype(np.float32), others)

    def half_pixel_distance(self, row: int) -> float:
        """Return the distance of a picture to itself moved by half a pixel along either side or both, the farthest.

        A moved copy lies no farther, unless it was changed otherwise too.
        """
        picture = self._pictures[row].astype(np.float32)
        return max(float(self._distances_to(cv2.blur(picture, size), [row])[0]) for size in _HALF_PIXEL_KERNELS)

    def _distances_to(self, picture: NDArray[np.float32], others: Sequence[int]) -> Doubles:
        """At each shift, the correlation of what remains of a part of `picture` with what remains of the inner part of
        the other: the latter is orthogonal to what is taken off, so it is multiplied with the picture as it is.
        """
        picture = picture - picture.mean()  # so that float32 holds its squares
        squares = cv2.matchTemplate(picture**2, np.ones_like(_ONES), cv2.TM_CCORR).astype(np.float64)
        taken = sum(cv2.matchTemplate(picture, one, cv2.TM_CCORR).astype(np.float64) ** 2 for one in self._basis())
        length = np.sqrt(np.maximum(squares - taken, 1.0))  # one grey level in all: what is fainter has no shape
        found = [(cv2.matchTemplate(picture, self._residual(other), cv2.TM_CCORR) / length).max() for other in others]
        return 1.0 - np.array(found, dtype=np.float64)

    def _basis(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return _ONES, self._common

    def _residual(self, row: int) -> NDArray[np.float32]:
        inner = _inner(self._pictures[row].astype(np.float32))
        for one in self._basis():
            inner = inner - (inner * one).sum(dtype=np.float64).astype(np.float32) * one
        return _unit(inner)


def _inner(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    return picture[MAX_SHIFT_PX:-MAX_SHIFT_PX, MAX_SHIFT_PX:-MAX_SHIFT_PX]


def _unit(values: NDArray[np.float32]) -> NDArray[np.float32]:
    length = float(np.linalg.norm(values))
    return np.ascontiguousarray(values / length if length > 1e-3 else np.zeros_like(values))
