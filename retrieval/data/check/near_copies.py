"""Near copies: pictures that another one was made into by encoding it again, more light, a shift or a flip.

All gel images of a sensor look alike, and so do photos of one table: what they share, the median picture of their kind,
says nothing. So each picture is reduced to 16 x 16 grey levels, the best multiple of the median picture and a constant
are taken off, and what remains is its shape. The distance of two pictures is 1 less the correlation of their shapes,
the least over the four flips of one of them: 0 for a copy, about 1 for unlike pictures.

How far a copy may lie is measured on the picture itself: it is saved as JPEG of quality 20, made a tenth brighter, and
moved by 2 pixels along either diagonal; the farthest of these, `SLACK` times as far, is its limit. A touch that hardly
differs from the untouched gel, or shows fine relief alone, loses its shape to such a change. So a picture counts as
CHECKED only where its limit is less than a quarter of the way to the third nearest other object, which is no copy; of
the others only copies are found that are as near as the gentlest of these changes, such as flipped ones.

Measured on simulated recordings of 12 objects: limits of .002 to .12, other objects from .17 on; JPEG 20 left 64-bit
perceptual hashes 0 to 18 bits from their picture, where other objects' touches began at 2: no threshold tells these
apart, since hashes see what the pictures share. Hence shapes, and no hash library with its wavelets.

Copies that were moved farther are found among the nearest pictures of the nearest objects by a finer comparison, at
every shift (`retrieval.data.check.shift_alignment`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

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
from retrieval.data.images import decode_rgb, read_bytes
from retrieval.data.resize import RgbImage

PX = 16
SLACK = 1.25
_FLIPS = ((1, 1), (-1, 1), (1, -1), (-1, -1))
_MOVES = tuple((rows, columns) for rows in (-1, 0, 1) for columns in (-1, 0, 1))
_MAX_PICTURES, _MAX_OBJECTS, _MAX_PER_OBJECT = 64, 5, 3
"""Pictures from which the candidates of the finer comparison are taken: how many objects, and how many of each."""
_BLOCK = 512
_NEIGHBOUR_RANK, _RELATIVE_LIMIT = 3, 0.25
_MIN_LIMIT, _MAX_LIMIT = 0.02, 0.1
"""Of pictures compared alone: what another size adds, and what unlike pictures do not reach (.34 was the nearest of
photos and touches on simulated recordings)."""

Greys = NDArray[np.float32]
"""(n, 256): thumbnails in grey levels of 255."""


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """One picture: the digest of its bytes, its grey levels (256,), those of its damaged copies (4, 256), and those of
    the finer comparison.
    """

    digest: str
    grey: Greys
    distorted: Greys
    fine_grey_levels: FineGreys


def load_thumbnail(path: Path) -> Thumbnail:
    """Read a picture. Raises ImageError."""
    data = read_bytes(path)
    return thumbnail(data, decode_rgb(data, path))


def thumbnail(data: bytes, image: RgbImage) -> Thumbnail:
    """The thumbnail of a picture: `data` are the bytes of its file, `image` what they decode to."""
    picture = np.rint(255 * image).astype(np.uint8)
    return Thumbnail(
        sha256(data).hexdigest(),
        _small(picture),
        np.stack([_small(distortion_limits(picture)) for distortion_limits in DISTORTIONS]),
        fine_grey_levels(picture),
    )


def _small(picture: NDArray[np.uint8]) -> Greys:
    grey = picture.mean(axis=2, dtype=np.float32)
    return np.asarray(cv2.resize(grey, (PX, PX), interpolation=cv2.INTER_AREA).ravel())


def as_jpeg(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Through JPEG of quality 20."""
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 20])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))  # blue and red change places twice


def brighter(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture with a tenth more light."""
    return np.asarray(np.clip(np.rint(picture * np.float32(1.1)), 0, 255).astype(np.uint8))


def shifted(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Moved by 2 pixels down and to the right; the border repeats."""
    height, width = picture.shape[:2]
    return np.asarray(np.pad(picture, ((2, 0), (2, 0), (0, 0)), "edge")[:height, :width])


def shifted_across(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Moved by 2 pixels down and to the left."""
    return shifted(picture[:, ::-1])[:, ::-1]


DISTORTIONS = (as_jpeg, brighter, shifted, shifted_across)


def shapes(greys: Greys, common: Greys | None = None) -> Greys:
    """Unit vectors (n, 256) of what is left of thumbnails without a constant and `common` (256,); zeros for nothing."""
    shared = [np.ones(PX**2, np.float32)] + ([] if common is None else [common])
    basis = np.linalg.qr(np.stack(shared, axis=1).astype(np.float64))[0].astype(np.float32)
    rest = greys - (greys @ basis) @ basis.T
    length = np.linalg.norm(rest, axis=-1, keepdims=True)
    return np.asarray(rest / np.where(length > 1e-3, length, np.inf))


def flip_thumbnails(greys: Greys, flip: tuple[int, int]) -> Greys:
    """Thumbnails (n, 256) of the flipped pictures."""
    turned = greys.reshape(-1, PX, PX)[:, :: flip[0], :: flip[1]]
    return np.ascontiguousarray(turned).reshape(-1, PX**2)


def is_copy(one: Thumbnail, other: Thumbnail) -> bool:
    """Whether `one` is a near copy of `other` by their own shapes, with nothing known of pictures of their kind."""
    original = shapes(other.grey)
    limit = max(SLACK * (1 - float((shapes(other.distorted) @ original).min())), _MIN_LIMIT)
    likeness = max(float(shapes(flip_thumbnails(one.grey[None], flip))[0] @ original) for flip in _FLIPS)
    return 1 - likeness <= min(limit, _MAX_LIMIT)


@dataclass(frozen=True, eq=False)
class NearestPictures:
    """For each of q queries, arrays (q,): row and distance of the nearest picture of another object, whether a copy of
    the query could have been told from other pictures, and whether that nearest one is a copy.
    """

    row: NDArray[np.int64]
    distance: NDArray[np.float64]
    checked: NDArray[np.bool_]
    copy: NDArray[np.bool_]


def shift_thumbnails(greys: Greys, rows: int, columns: int) -> Greys:
    """Thumbnails (n, 256) moved by at most one of their pixels down and to the right; the border repeats."""
    padded = np.pad(greys.reshape(-1, PX, PX), ((0, 0), (1, 1), (1, 1)), "edge")
    part = padded[:, 1 - rows : 1 - rows + PX, 1 - columns : 1 - columns + PX]
    return np.ascontiguousarray(part).reshape(-1, PX**2)


class PictureSet:
    """All pictures of one kind, such as the photos or the touches of one finger, and the objects that they are of."""

    def __init__(self, thumbnails: Sequence[Thumbnail], objects: Sequence[str]) -> None:
        self.greys = np.array([one.grey for one in thumbnails], dtype=np.float32).reshape(-1, PX**2)
        self.common = np.median(self.greys, axis=0) if len(self.greys) else None
        self.objects = np.unique(np.array(objects, dtype=str), return_inverse=True)[1]
        self._shapes = shapes(self.greys, self.common)
        copies = [shapes(one.distorted, self.common) for one in thumbnails]
        likeness = [copy @ shape for copy, shape in zip(copies, self._shapes, strict=True)]
        self.distortion_limits = SLACK * (1 - np.array(likeness, dtype=np.float64).reshape(-1, len(DISTORTIONS)))
        self._aligned = AlignedSet([one.fine_grey_levels for one in thumbnails])

    def nearest(self, queries: NDArray[np.int64], among: NDArray[np.int64]) -> NearestPictures:
        """For each of the pictures `queries` (rows of this set), the nearest of those in `among` that show another
        object.
        """
        if not len(queries) or not len(among):
            nothing = np.zeros(len(queries), dtype=bool)
            return NearestPictures(np.zeros(len(queries), np.int64), np.full(len(queries), np.inf), nothing, nothing)
        among = among[np.argsort(self.objects[among], kind="stable")]
        blocks = [queries[at : at + _BLOCK] for at in range(0, len(queries), _BLOCK)]
        parts = [self._nearest(block, among) for block in blocks]
        row, distance, third = (np.concatenate(part) for part in zip(*parts, strict=True))
        most = _RELATIVE_LIMIT * third
        checked = self.distortion_limits[queries].max(axis=1) < most
        # Either may be the copy, and what was saved as JPEG once hardly changes the next time.
        distortion_limits = np.maximum(self.distortion_limits[queries], self.distortion_limits[row])
        farthest, gentlest = distortion_limits.max(axis=1), distortion_limits.min(axis=1)
        limit = np.where(farthest < most, farthest, np.minimum(gentlest, most))
        found = NearestPictures(row, distance, checked, np.asarray(distance <= limit))
        return self._add_shifted_copies(
            queries, [one for block in blocks for one in self._candidates(block, among)], found
        )

    def _add_shifted_copies(
        self, queries: NDArray[np.int64], candidates: Sequence[list[int]], found: NearestPictures
    ) -> NearestPictures:
        """What was found, and those of each query's candidates that are copies of it which were moved."""
        row, distance, checked, copy = (
            found.row.copy(),
            found.distance.copy(),
            found.checked.copy(),
            found.copy.copy(),
        )
        for at, (query, others) in enumerate(zip(queries.tolist(), candidates, strict=True)):
            if not others or copy[at]:
                continue
            away = self._aligned.distances(query, others)
            by_object = np.sort([away[self.objects[others] == one].min() for one in np.unique(self.objects[others])])
            third = by_object[_NEIGHBOUR_RANK - 1] if len(by_object) >= _NEIGHBOUR_RANK else 1.0
            most = min(MAX_DISTANCE, RELATIVE_LIMIT * third)
            nearest = int(away.argmin())
            own, its = (SLACK * self._aligned.half_pixel_distance(one) for one in (query, others[nearest]))
            checked[at] |= max(own, MIN_LIMIT) <= most
            if away[nearest] <= min(max(own, its, MIN_LIMIT), most):  # either may be the copy
                row[at], distance[at], copy[at] = others[nearest], away[nearest], True
        return NearestPictures(row, distance, checked, copy)

    def _nearest(
        self, queries: NDArray[np.int64], among: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Row of the nearest picture of another object, its distance, and that of the third nearest other object (1
        where there are fewer). `among` is sorted by object.
        """
        distance = self._min_distances(queries, among, [flip_thumbnails(self.greys[queries], flip) for flip in _FLIPS])
        first = np.flatnonzero(np.diff(self.objects[among], prepend=-1))
        by_object = np.sort(np.minimum.reduceat(distance, first, axis=1), axis=1)
        third = (
            by_object[:, _NEIGHBOUR_RANK - 1]
            if by_object.shape[1] >= _NEIGHBOUR_RANK
            else np.full(len(queries), np.inf)
        )
        at = distance.argmin(axis=1)
        return among[at], distance[np.arange(len(queries)), at], np.minimum(third, 1.0)

    def _candidates(self, queries: NDArray[np.int64], among: NDArray[np.int64]) -> list[list[int]]:
        """For each query the nearest pictures, roughly moved: a few of each of the nearest other objects."""
        distance = self._min_distances(queries, among, [shift_thumbnails(self.greys[queries], *by) for by in _MOVES])
        found = []
        for away in distance:
            near: dict[int, list[int]] = {}
            for place in np.argsort(away, kind="stable")[:_MAX_PICTURES].tolist():
                owner = int(self.objects[among[place]])
                if np.isfinite(away[place]) and (owner in near or len(near) < _MAX_OBJECTS):
                    near.setdefault(owner, []).append(int(among[place]))
            found.append([row for rows in near.values() for row in rows[:_MAX_PER_OBJECT]])
        return found

    def _min_distances(self, queries: NDArray[np.int64], among: NDArray[np.int64], turned: Sequence[Greys]) -> Doubles:
        """The least distance (q, n) of any of the turned thumbnails of each query to each picture of another object;
        infinity for the query's own.
        """
        likeness = np.full((len(queries), len(among)), -1.0, np.float32)
        for greys in turned:
            np.maximum(likeness, shapes(greys, self.common) @ self._shapes[among].T, out=likeness)
        distance = 1.0 - likeness.astype(np.float64)
        distance[self.objects[queries][:, None] == self.objects[among]] = np.inf
        return distance

    def within_object_distances(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Distance of each of the pictures to the nearest other one of its own object; objects with one are left
        out.
        """
        found = [np.zeros(0)]
        for name in np.unique(self.objects[rows]):
            own = self._shapes[rows[self.objects[rows] == name]]
            likeness = own @ own.T
            np.fill_diagonal(likeness, -np.inf)
            if len(own) > 1:
                found.append(1.0 - likeness.max(axis=1).astype(np.float64))
        return np.concatenate(found)
