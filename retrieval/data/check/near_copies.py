"""Near copies: pictures made from another one by a new encoding, more light, a small shift or a flip.

All gel images of a sensor look alike, and so do photos of one table: the median picture of their kind carries no
information. So each picture is reduced to 16 x 16 grey levels, the best multiple of the median picture and a constant
are subtracted, and the residual is its shape. The distance of two pictures is 1 minus the correlation of their shapes,
the minimum over the four flips of one of them: 0 for a copy, about 1 for unlike pictures.

Each picture has its own limit for the distance of a copy. The picture is saved as JPEG of quality 20, made a tenth
brighter, and moved by 2 pixels along either diagonal. The limit is `SLACK` times the largest distance of these four. A
touch that hardly differs from the no-contact frame, or shows only fine relief, loses its shape by such a change. So a
picture is CHECKED only if its limit is less than a quarter of the distance to the third nearest other object.
For the other pictures, only copies as near as the mildest of the four changes are found, such as flips.

Measured on simulated recordings of 12 objects: limits of .002 to .12, other objects from .17 on. JPEG 20 changed 0 to
18 bits of 64-bit perceptual hashes, while touches of other objects differed from 2 bits on: no threshold separates
them, since hashes depend on the common content of the pictures. So this module compares shapes.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from retrieval.data.resize import RgbImage

PX = 16
SLACK = 1.25
_FLIPS = ((1, 1), (-1, 1), (1, -1), (-1, -1))
_BLOCK = 512
_NEIGHBOUR_RANK, _RELATIVE_LIMIT = 3, 0.25
Greys = NDArray[np.float32]
"""(n, 256): small pictures in grey levels 0..255."""


def thumbnail(image: RgbImage) -> Greys:
    """Return small grey levels (5, 256) of a picture (H, W, 3), then of its distorted copies, as in `DISTORTIONS`."""
    picture = np.rint(255 * image).astype(np.uint8)
    return np.stack([_small(picture), *(_small(distort(picture)) for distort in DISTORTIONS)])


def _small(picture: NDArray[np.uint8]) -> Greys:
    grey = picture.mean(axis=2, dtype=np.float32)
    return np.asarray(cv2.resize(grey, (PX, PX), interpolation=cv2.INTER_AREA).ravel())


def _as_jpeg(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 20])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))  # the two swaps of blue and red cancel


def _brighter(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(np.clip(np.rint(picture * np.float32(1.1)), 0, 255).astype(np.uint8))


def _shifted(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture moved by 2 pixels down and to the right; the border repeats."""
    height, width = picture.shape[:2]
    return np.asarray(np.pad(picture, ((2, 0), (2, 0), (0, 0)), "edge")[:height, :width])


def _shifted_across(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return _shifted(picture[:, ::-1])[:, ::-1]


DISTORTIONS = (_as_jpeg, _brighter, _shifted, _shifted_across)


def shapes(greys: Greys, common: Greys) -> Greys:
    """Return the shapes of small pictures (..., 256): the residuals after a constant and `common` (256,).

    They are unit vectors, or zero.
    """
    shared = np.stack([np.ones(PX**2, np.float32), common], axis=1)
    basis = np.linalg.qr(shared.astype(np.float64))[0].astype(np.float32)
    rest = greys - (greys @ basis) @ basis.T
    length = np.linalg.norm(rest, axis=-1, keepdims=True)
    return np.asarray(rest / np.where(length > 1e-3, length, np.inf))


def flip_greys(greys: Greys, flip: tuple[int, int]) -> Greys:
    """Return the flipped small pictures (n, 256)."""
    turned = greys.reshape(-1, PX, PX)[:, :: flip[0], :: flip[1]]
    return np.ascontiguousarray(turned).reshape(-1, PX**2)


def nearest_pictures(
    thumbnails: Sequence[Greys], objects: Sequence[str]
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Find the nearest picture of another object for each of n pictures of one kind, such as the photos.

    Args:
        thumbnails: Thumbnails of the pictures.
        objects: The object of each picture.

    Returns:
        (n,) the row of the nearest picture; whether a copy of the picture can be distinguished from other pictures;
        and whether the nearest picture is a copy.
    """
    stacked = np.array(thumbnails, dtype=np.float32).reshape(-1, 1 + len(DISTORTIONS), PX**2)
    greys, distorted = stacked[:, 0], stacked[:, 1:]
    owner = np.unique(np.array(objects, dtype=str), return_inverse=True)[1]
    common = np.median(greys, axis=0) if len(greys) else np.zeros(PX**2, np.float32)
    originals = shapes(greys, common)

    row, distance, third = np.zeros(len(greys), np.int64), np.zeros(len(greys)), np.ones(len(greys))
    by_owner = np.argsort(owner, kind="stable")
    first = np.flatnonzero(np.diff(owner[by_owner], prepend=-1))
    for start in range(0, len(greys), _BLOCK):
        block = slice(start, start + _BLOCK)
        flipped = [shapes(flip_greys(greys[block], flip), common) for flip in _FLIPS]
        distances = 1.0 - np.max([each @ originals[by_owner].T for each in flipped], axis=0).astype(np.float64)
        distances[owner[block, None] == owner[by_owner]] = np.inf
        row[block], distance[block] = by_owner[distances.argmin(axis=1)], distances.min(axis=1)
        by_object = np.sort(np.minimum.reduceat(distances, first, axis=1), axis=1)
        if by_object.shape[1] >= _NEIGHBOUR_RANK:
            third[block] = np.minimum(by_object[:, _NEIGHBOUR_RANK - 1], 1.0)

    maximum = _RELATIVE_LIMIT * third
    limits = SLACK * (1 - np.einsum("nck,nk->nc", shapes(distorted, common), originals).astype(np.float64))
    checked = limits.max(axis=1) < maximum
    limits = np.maximum(limits, limits[row])  # either may be the copy: a second compression as JPEG changes little
    farthest, nearest = limits.max(axis=1), limits.min(axis=1)
    limit = np.where(farthest < maximum, farthest, np.minimum(nearest, maximum))
    return row, checked, distance <= limit
