"""What pictures of a recording look like together: fingers, moments, light and photos that do not fit the others.

Every judgement is made against the recording itself: a minority is suspect, and where looks do not tell two things
apart (gels that are alike, touches without contact, objects of one colour) nothing is said, but how much could not be
checked. Arrays hold small pictures (n, h, w, 3) of one kind, 0..1.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

SmallImages = NDArray[np.float32]
Rows = NDArray[np.int64]

_MIN_FINGER_DIFFERENCE = 0.3  # how near to nothing, of its median, the difference of two fingers may come
_NOISE_TIMES = 5.0
_MIN_NOISE = 0.25 / 255
_NEARER = 0.5  # logarithm: 40 % nearer
_FOREGROUND = 25.0
_BINS = 16


# Fingers -----------------------------------------------------------------------------------------------------


def swapped_fingers(a: SmallImages, b: SmallImages) -> Rows | None:
    """Grasps whose frames of fingers a and b look exchanged; None where the gels are too much alike to tell.

    The difference of the two gels is the same in every grasp but for contact and its sign. Its direction is that of the
    largest sum of squares, and the sign that of most grasps.
    """
    differences = (a - b).reshape(len(a), -1)
    along = differences @ np.linalg.svd(differences, full_matrices=False)[2][0]
    size = np.abs(along)
    if not size.any() or np.quantile(size, 0.05) < _MIN_FINGER_DIFFERENCE * np.median(size):
        return None
    usual = 1.0 if 2 * (along > 0).sum() >= len(along) else -1.0
    return np.flatnonzero(usual * along < 0)


# Moments -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MomentSwaps:
    """What the moments at which frames were taken look like.

    swapped: grasps whose frames before and during the contact look exchanged. throughout: whether all do. faint: how
    many touches differ too little from the untouched gel to tell.
    """

    swapped: Rows
    all_swapped: bool
    low_contact: int


def swapped_moments(before: SmallImages, during: SmallImages) -> MomentSwaps:
    """Frames of the untouched gel are all alike, touches are not: what lies far from the median of the frames before
    belongs among the touches.
    """
    spread = [float(np.median(distance(frames, np.median(frames, axis=0)))) for frames in (before, during)]
    if spread[0] > max(2 * spread[1], _NOISE_TIMES * _MIN_NOISE):
        return MomentSwaps(np.zeros(0, np.int64), True, 0)
    untouched, touched = (distance(frames, np.median(before, axis=0)) for frames in (before, during))
    noise = max(float(np.quantile(untouched, 0.25)), _MIN_NOISE)
    far = _NOISE_TIMES * noise
    swapped = np.flatnonzero((untouched > far) & (touched < untouched / 2))
    return MomentSwaps(swapped, False, int(((untouched <= far) & (touched <= far)).sum()))


def distance(images: SmallImages, centre: SmallImages) -> NDArray[np.float64]:
    """Root mean square (n,) of how far each image is from `centre` (h, w, 3)."""
    return np.asarray(np.sqrt(np.mean((images - centre) ** 2, axis=(1, 2, 3), dtype=np.float64)))


# Light -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NearestGraspAccuracy:
    """How often the nearest other grasp is one of the same object, how often by chance, and of how many grasps."""

    accuracy: float
    chance: float
    grasps: int

    def exceeds_chance(self, part: float) -> bool:
        """Whether it goes more than `part` of the way from chance to always, and more than chance would by itself."""
        scatter = np.sqrt(self.chance * (1 - self.chance) / max(self.grasps, 1))
        least = max(part * (1 - self.chance), 5 * scatter)
        return bool(self.grasps > 0 and self.accuracy > self.chance + least)


def nearest_grasp_accuracy(values: NDArray[np.floating], objects: NDArray[np.int64]) -> NearestGraspAccuracy:
    """Whether values (n, k) of grasps name their objects (n,), by the nearest other grasp."""
    flat = values.reshape(len(values), -1).astype(np.float64)
    flat = flat - flat.mean(axis=0)
    squares = (flat**2).sum(axis=1)
    right = []
    for row in range(len(flat)):
        far = squares - 2 * (flat @ flat[row])
        far[row] = np.inf
        right.append(objects[far.argmin()] == objects[row])
    others = np.bincount(objects)[objects] - 1
    some = others > 0
    if not some.any():
        return NearestGraspAccuracy(0.0, 0.0, 0)
    chance = others[some].mean() / (len(objects) - 1)
    return NearestGraspAccuracy(float(np.mean(np.array(right)[some])), float(chance), int(some.sum()))


# Photos ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PhotoExchanges:
    """Photos that look exchanged between objects.

    pairs: grasps (row, row) of two objects whose photos look exchanged. distinguishable_pairs: of how many pairs of objects
    (`all`) the photos look different enough for that to be noticed.
    """

    pairs: list[tuple[int, int]]
    distinguishable_pairs: int
    all: int


def exchanged_photos(photos: SmallImages, objects: NDArray[np.int64]) -> PhotoExchanges:
    """Two grasps of two objects, each photo nearer in colour to the other object's photos than to its own object's,
    where every other photo of both objects is nearer to its own.

    Objects with fewer than four photos are passed over. Colour is the chromaticity of what stands out from the median
    photo. Measured on five simulated recordings of 12 and 40 objects, every photo under another light: none is called
    exchanged that is not, and of single exchanges 5, 20, 35, 65 and 70 % are found. Fixed light tells more.
    """
    counts = np.bincount(objects)
    names = np.flatnonzero(counts >= 4)
    members = [np.flatnonzero(objects == name) for name in names]
    colours = _colours(photos)
    far = np.stack([_to_object(colours, own) for own in members], axis=1) if members else np.zeros((len(photos), 0))
    worst, second, which = (np.zeros((len(names), len(names))) for _ in range(3))
    for at, own in enumerate(members):
        nearer = np.log(far[own, at][:, None] / far[own])
        order = np.argsort(nearer, axis=0, kind="stable")
        second[at] = np.take_along_axis(nearer, order[-2:-1], 0)[0]
        worst[at], which[at] = np.take_along_axis(nearer, order[-1:], 0)[0], own[order[-1]]
    apart = np.triu((second < 0) & (second.T < 0), 1)
    pairs = np.argwhere(apart & (worst > _NEARER) & (worst.T > _NEARER))
    return PhotoExchanges(
        [(int(which[one, other]), int(which[other, one])) for one, other in pairs],
        int(apart.sum()),
        len(np.unique(objects)) * (len(np.unique(objects)) - 1) // 2,
    )


def _to_object(colours: NDArray[np.float64], own: Rows) -> NDArray[np.float64]:
    """Median distance (n,) of every photo to an object's photos, without the one that is farthest, or itself."""
    squares = 2 - 2 * colours @ colours[own].T
    far = np.sqrt(np.maximum(squares, 1e-9))
    far[own, np.arange(len(own))] = np.inf
    return np.asarray(np.median(np.sort(far, axis=1)[:, :-1], axis=1))


def _colours(photos: SmallImages) -> NDArray[np.float64]:
    """Unit vectors (n, 256): square roots of the share of the foreground's pixels in each bin of chromaticity."""
    usual = 255 * np.median(photos, axis=0)
    found = []
    for photo in 255 * photos:
        light = np.median(photo / np.maximum(usual, 1))
        pixels = photo[np.abs(photo - light * usual).max(axis=2) > _FOREGROUND]
        pixels = pixels if len(pixels) > 20 else photo.reshape(-1, 3)
        accuracy = pixels[:, :2] / (pixels.sum(axis=1, keepdims=True) + 1)
        counts = np.histogram2d(accuracy[:, 0], accuracy[:, 1], bins=_BINS, range=((0.1, 0.7), (0.1, 0.7)))[0]
        counts = cv2.GaussianBlur(counts, (3, 3), 0).ravel() + 1e-9
        found.append(np.sqrt(counts / counts.sum()))
    return np.array(found)
