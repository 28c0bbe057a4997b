"""Near copies: pictures made from another one by a new encoding, more light, a shift or a flip.

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

Copies with larger shifts are found among the nearest pictures of the nearest objects by a finer comparison, at
every shift (`retrieval.data.check.shift_alignment`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from retrieval.data.check.shift_alignment import (
    MAX_DISTANCE,
    MIN_LIMIT,
    RELATIVE_LIMIT,
    AlignedSet,
    Doubles,
    FineGreys,
    fine_grey_levels,
)
from retrieval.data.resize import RgbImage

PX = 16
SLACK = 1.25
_FLIPS = ((1, 1), (-1, 1), (1, -1), (-1, -1))
_MOVES = tuple((rows, columns) for rows in (-1, 0, 1) for columns in (-1, 0, 1))
_MAX_PICTURES, _MAX_OBJECTS, _MAX_PER_OBJECT = 64, 5, 3
"""Candidates of the finer comparison: numbers of nearest pictures, of objects, and of pictures of each object."""
_BLOCK = 512
_NEIGHBOUR_RANK, _RELATIVE_LIMIT = 3, 0.25
_MIN_LIMIT, _MAX_LIMIT = 0.02, 0.1
"""Limits for a comparison of only two pictures: the effect of a new size, and a distance below that of unlike pictures
(.34 was the smallest between photos and touches on simulated recordings)."""

Greys = NDArray[np.float32]
"""(n, 256): thumbnails in grey levels 0..255."""


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """One picture, reduced for the comparison.

    Attributes:
        grey: Grey levels (256,).
        distorted: Grey levels of the distorted copies (4, 256), in the order of `DISTORTIONS`.
        fine_grey_levels: Grey levels of the finer comparison.
    """

    grey: Greys
    distorted: Greys
    fine_grey_levels: FineGreys


def thumbnail(image: RgbImage) -> Thumbnail:
    """Return the thumbnail of a picture (H, W, 3)."""
    picture = np.rint(255 * image).astype(np.uint8)
    distorted = np.stack([_small(distort(picture)) for distort in DISTORTIONS])
    return Thumbnail(_small(picture), distorted, fine_grey_levels(picture))


def _small(picture: NDArray[np.uint8]) -> Greys:
    grey = picture.mean(axis=2, dtype=np.float32)
    return np.asarray(cv2.resize(grey, (PX, PX), interpolation=cv2.INTER_AREA).ravel())


def as_jpeg(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture after JPEG compression of quality 20."""
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 20])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))  # the two swaps of blue and red cancel


def brighter(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture with a tenth more light."""
    return np.asarray(np.clip(np.rint(picture * np.float32(1.1)), 0, 255).astype(np.uint8))


def shifted(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture moved by 2 pixels down and to the right; the border repeats."""
    height, width = picture.shape[:2]
    return np.asarray(np.pad(picture, ((2, 0), (2, 0), (0, 0)), "edge")[:height, :width])


def shifted_across(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture moved by 2 pixels down and to the left; the border repeats."""
    return shifted(picture[:, ::-1])[:, ::-1]


DISTORTIONS = (as_jpeg, brighter, shifted, shifted_across)


def shapes(greys: Greys, common: Greys | None = None) -> Greys:
    """Return the shapes of thumbnails as unit vectors (n, 256): the residuals after a constant and `common` (256,).

    A residual of zero gives zeros.
    """
    shared = [np.ones(PX**2, np.float32)] + ([] if common is None else [common])
    basis = np.linalg.qr(np.stack(shared, axis=1).astype(np.float64))[0].astype(np.float32)
    rest = greys - (greys @ basis) @ basis.T
    length = np.linalg.norm(rest, axis=-1, keepdims=True)
    return np.asarray(rest / np.where(length > 1e-3, length, np.inf))


def flip_thumbnails(greys: Greys, flip: tuple[int, int]) -> Greys:
    """Return the thumbnails (n, 256) of the flipped pictures."""
    turned = greys.reshape(-1, PX, PX)[:, :: flip[0], :: flip[1]]
    return np.ascontiguousarray(turned).reshape(-1, PX**2)


def is_copy(one: Thumbnail, other: Thumbnail) -> bool:
    """Return whether `one` is a near copy of `other`, by their shapes without a median picture."""
    original = shapes(other.grey)
    limit = max(SLACK * (1 - float((shapes(other.distorted) @ original).min())), _MIN_LIMIT)
    similarity = max(float(shapes(flip_thumbnails(one.grey[None], flip))[0] @ original) for flip in _FLIPS)
    return 1 - similarity <= min(limit, _MAX_LIMIT)


@dataclass(frozen=True, eq=False)
class NearestPictures:
    """The nearest picture of another object for each picture, in arrays (n,).

    Attributes:
        row: Row of the nearest picture.
        distance: Its distance.
        checked: Whether a copy of the picture can be distinguished from other pictures.
        copy: Whether the nearest picture is a copy.
    """

    row: NDArray[np.int64]
    distance: NDArray[np.float64]
    checked: NDArray[np.bool_]
    copy: NDArray[np.bool_]


def shift_thumbnails(greys: Greys, rows: int, columns: int) -> Greys:
    """Return thumbnails (n, 256) moved by `rows` down and `columns` to the right (-1..1); the border repeats."""
    padded = np.pad(greys.reshape(-1, PX, PX), ((0, 0), (1, 1), (1, 1)), "edge")
    part = padded[:, 1 - rows : 1 - rows + PX, 1 - columns : 1 - columns + PX]
    return np.ascontiguousarray(part).reshape(-1, PX**2)


class PictureSet:
    """All pictures of one kind, such as the photos or the touches of one finger, with their objects."""

    def __init__(self, thumbnails: Sequence[Thumbnail], objects: Sequence[str]) -> None:
        self.greys = np.array([one.grey for one in thumbnails], dtype=np.float32).reshape(-1, PX**2)
        self.common = np.median(self.greys, axis=0) if len(self.greys) else None
        self.objects = np.unique(np.array(objects, dtype=str), return_inverse=True)[1]
        self._shapes = shapes(self.greys, self.common)
        copies = [shapes(one.distorted, self.common) for one in thumbnails]
        similarity = [copy @ shape for copy, shape in zip(copies, self._shapes, strict=True)]
        self.distortion_limits = SLACK * (1 - np.array(similarity, dtype=np.float64).reshape(-1, len(DISTORTIONS)))
        self._aligned = AlignedSet([one.fine_grey_levels for one in thumbnails])

    def nearest(self) -> NearestPictures:
        """Return the nearest picture of another object for each picture."""
        rows, among = np.arange(len(self.greys)), np.argsort(self.objects, kind="stable")
        if not len(rows):
            nothing = np.zeros(0, bool)
            return NearestPictures(rows, np.zeros(0), nothing, nothing)
        blocks = [rows[at : at + _BLOCK] for at in range(0, len(rows), _BLOCK)]
        parts = [self._nearest(block, among) for block in blocks]
        row, distance, third = (np.concatenate(part) for part in zip(*parts, strict=True))
        maximum = _RELATIVE_LIMIT * third
        checked = self.distortion_limits.max(axis=1) < maximum
        # Either picture may be the copy. A picture that was saved as JPEG hardly changes the second time.
        distortion_limits = np.maximum(self.distortion_limits, self.distortion_limits[row])
        farthest, nearest = distortion_limits.max(axis=1), distortion_limits.min(axis=1)
        limit = np.where(farthest < maximum, farthest, np.minimum(nearest, maximum))
        found = NearestPictures(row, distance, checked, np.asarray(distance <= limit))
        self._add_shifted_copies([one for block in blocks for one in self._candidates(block, among)], found)
        return found

    def _add_shifted_copies(self, candidates: Sequence[list[int]], found: NearestPictures) -> None:
        """Replace results in `found` by candidates that are shifted copies of their picture."""
        for at, others in enumerate(candidates):
            if not others or found.copy[at]:
                continue
            distances = self._aligned.distances(at, others)
            objects = self.objects[others]
            by_object = np.sort([distances[objects == one].min() for one in np.unique(objects)])
            third = by_object[_NEIGHBOUR_RANK - 1] if len(by_object) >= _NEIGHBOUR_RANK else 1.0
            maximum = min(MAX_DISTANCE, RELATIVE_LIMIT * third)
            nearest = int(distances.argmin())
            own, its = (SLACK * self._aligned.half_pixel_distance(one) for one in (at, others[nearest]))
            found.checked[at] |= max(own, MIN_LIMIT) <= maximum
            if distances[nearest] <= min(max(own, its, MIN_LIMIT), maximum):  # either picture may be the copy
                found.row[at], found.distance[at], found.copy[at] = others[nearest], distances[nearest], True

    def _nearest(
        self, queries: NDArray[np.int64], among: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return row and distance of the nearest picture of another object, and the third nearest object's distance.

        The last is 1 if there are fewer than three other objects. `among` must be sorted by object.
        """
        distance = self._min_distances(queries, among, [flip_thumbnails(self.greys[queries], flip) for flip in _FLIPS])
        first = np.flatnonzero(np.diff(self.objects[among], prepend=-1))
        by_object = np.sort(np.minimum.reduceat(distance, first, axis=1), axis=1)
        third = np.ones(len(queries))
        if by_object.shape[1] >= _NEIGHBOUR_RANK:
            third = np.minimum(by_object[:, _NEIGHBOUR_RANK - 1], 1.0)
        at = distance.argmin(axis=1)
        return among[at], distance[np.arange(len(queries)), at], third

    def _candidates(self, queries: NDArray[np.int64], among: NDArray[np.int64]) -> list[list[int]]:
        """Return candidates for each query, nearest under coarse shifts: a few pictures of each of a few objects."""
        distance = self._min_distances(queries, among, [shift_thumbnails(self.greys[queries], *by) for by in _MOVES])
        candidates = []
        for row in distance:
            near: dict[int, list[int]] = {}
            for at in np.argsort(row, kind="stable")[:_MAX_PICTURES].tolist():
                owner = int(self.objects[among[at]])
                if np.isfinite(row[at]) and (owner in near or len(near) < _MAX_OBJECTS):
                    near.setdefault(owner, []).append(int(among[at]))
            candidates.append([row for rows in near.values() for row in rows[:_MAX_PER_OBJECT]])
        return candidates

    def _min_distances(
        self, queries: NDArray[np.int64], among: NDArray[np.int64], variants: Sequence[Greys]
    ) -> Doubles:
        """Return each query's minimum distance (q, n) over variants to each picture; infinity for its own object."""
        similarity = np.full((len(queries), len(among)), -1.0, np.float32)
        for greys in variants:
            np.maximum(similarity, shapes(greys, self.common) @ self._shapes[among].T, out=similarity)
        distance = 1.0 - similarity.astype(np.float64)
        distance[self.objects[queries][:, None] == self.objects[among]] = np.inf
        return distance
