"""Shifted near copies: the correlation of two pictures at the best of many shifts.

`retrieval.data.check.near_copies` compares 16 x 16 grey levels without shifts, and misses a copy that was moved by a
few pixels. Here pictures have 128 x 128 grey levels, and the inner part of one is compared with the other at every
shift of up to a sixteenth of the side. At each shift a constant and the best multiple of the median picture of their
kind are subtracted. The distance is 1 minus the largest correlation of the residuals.

Measured with different objects: the nearest of 7,000 pairs lay at .145 (photos) and .136 (touches) on the simulated
rig, at .066 (photos) and .015 (touches: smooth objects, pressed alike) on VT60. A picture that was moved by 6 pixels
and saved again as JPEG 90 lies at most .002 (photos) and .05 (touches) from its original. No threshold fits all cases,
so a copy must be four times as near as the third nearest other object.
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
"""Largest number of pictures, evenly spaced, for the median picture."""
_HALF_PIXEL_KERNELS = ((1, 2), (2, 1), (2, 2))
_ONES = np.full((SIDE, SIDE), 1 / SIDE, np.float32)

Doubles = NDArray[np.float64]
FineGreys = NDArray[np.float16]
"""(PX, PX): grey levels 0..255, each within .06."""


def fine_grey_levels(picture: NDArray[np.uint8] | RgbImage) -> FineGreys:
    """Return the grey levels (PX, PX) of a picture (H, W, 3), in the picture's unit."""
    grey = picture.mean(axis=2, dtype=np.float32)
    return np.asarray(cv2.resize(grey, (PX, PX), interpolation=cv2.INTER_AREA).astype(np.float16))


class AlignedSet:
    """Pictures of one kind, (n, PX, PX), for comparison at every shift."""

    def __init__(self, pictures: Sequence[FineGreys]) -> None:
        self._pictures = pictures
        sample = pictures[:: max(1, -(-len(pictures) // _MAX_MEDIAN_PICTURES))]
        common = np.median(np.array(sample, np.float32), axis=0) if len(sample) else np.zeros((PX, PX), np.float32)
        self._common = _unit(_inner(common) - _inner(common).mean())

    def distances(self, row: int, others: Sequence[int]) -> Doubles:
        """Return the distance of picture `row` to each of the others (n,): 0 for a copy, about 1 for unlike ones."""
        return self._distances_to(self._pictures[row].astype(np.float32), others)

    def half_pixel_distance(self, row: int) -> float:
        """Return the largest distance of a picture to itself moved by half a pixel along one axis or both.

        A shifted copy without other changes lies no farther.
        """
        picture = self._pictures[row].astype(np.float32)
        return max(float(self._distances_to(cv2.blur(picture, size), [row])[0]) for size in _HALF_PIXEL_KERNELS)

    def _distances_to(self, picture: NDArray[np.float32], others: Sequence[int]) -> Doubles:
        """Return the distances of `picture` to the others (n,).

        At each shift, correlate the residual of a part of `picture` with the residual of the other's inner part. The
        latter is orthogonal to the subtracted basis, so it is multiplied with the unchanged picture.
        """
        picture = picture - picture.mean()  # keeps the squares exact in float32
        squares = cv2.matchTemplate(picture**2, np.ones_like(_ONES), cv2.TM_CCORR).astype(np.float64)
        removed = sum(cv2.matchTemplate(picture, one, cv2.TM_CCORR).astype(np.float64) ** 2 for one in self._basis())
        length = np.sqrt(np.maximum(squares - removed, 1.0))  # a residual below one grey level in total has no shape
        best = [(cv2.matchTemplate(picture, self._residual(other), cv2.TM_CCORR) / length).max() for other in others]
        return 1.0 - np.array(best, dtype=np.float64)

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
