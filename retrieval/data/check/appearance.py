"""Pictures of a recording that look exchanged, mirrored, or as if their red and blue were exchanged.

The reference is the recording itself: a minority is suspect. A note reports two fingers whose gels are too
similar to find exchanges.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from string import ascii_lowercase

import numpy as np
from numpy.typing import NDArray

from retrieval.data.check.pictures import Finding, ImageRecords, SmallImages, findings_for, fingers_of, small_images
from retrieval.data.dataset import Grasp

Rows = NDArray[np.int64]

CHANGES = {
    "red and blue exchanged": (slice(None), slice(None), slice(None), slice(None, None, -1)),
    "left and right mirrored": (slice(None), slice(None), slice(None, None, -1)),
    "top and bottom mirrored": (slice(None), slice(None, None, -1)),
}
"""Changes of images (n, h, w, 3) that leave an image unchanged if they are applied twice."""
_MAX_RATIO = 0.6
"""The change must reduce the distance to the other images at least to this fraction, in the median."""
_MIN_GRASPS = 4
_MIN_FINGER_DIFFERENCE = 0.3
"""Smallest difference of two fingers, relative to its median."""
_NOISE_TIMES = 5.0
_MIN_NOISE = 0.25 / 255


def distance(images: SmallImages, centre: SmallImages) -> NDArray[np.float64]:
    """Return the root mean square difference (n,) of each image from `centre` (h, w, 3)."""
    return np.asarray(np.sqrt(np.mean((images - centre) ** 2, axis=(1, 2, 3), dtype=np.float64)))


def _spread(images: SmallImages) -> float:
    return float(np.median(distance(images, np.median(images, axis=0))))


def _with_backgrounds(grasps: Sequence[Grasp]) -> list[Grasp]:
    return [grasp for grasp in grasps if grasp.backgrounds and len(grasp.backgrounds) == len(grasp.touches)]


def check_swapped_modalities(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find photos and touches that look exchanged.

    Gel images look alike (the gel's tint and lamps); photos of different objects do not. So small pictures of touches
    lie close to their median, and photos lie far from it. A grasp is suspect if its photo lies at less than half
    the distance of its touch. The whole recording is suspect if its photos are twice as alike as its touches.
    """
    grasps = [grasp for grasp in grasps if grasp.photos]
    if len(grasps) < 3:
        return
    touches = small_images(records, [grasp.touches[0] for grasp in grasps])
    photos = small_images(records, [grasp.photo for grasp in grasps])
    if _spread(photos) < _spread(touches) / 2:
        yield Finding(
            "error",
            "swapped",
            "touches and photos look swapped throughout (the photos resemble each other more than the touches do, "
            "usually it is the reverse); exchange the columns",
            tuple(grasp.grasp_id for grasp in grasps),
        )
        return
    centre = np.median(touches, axis=0)
    closer = distance(photos, centre) < distance(touches, centre) / 2
    names = [grasp.grasp_id for grasp, suspect in zip(grasps, closer, strict=True) if suspect]
    yield from findings_for("error", "swapped", "touch and photo look swapped", names, grasps)


def swapped_fingers(a: SmallImages, b: SmallImages) -> Rows | None:
    """Return the grasps whose frames of fingers a and b look exchanged, or None if the gels are too similar.

    Without contact, the difference of the two gels is the same in every grasp; an exchange changes its sign. The
    direction of the difference is the one with the largest sum of squares. Its normal sign is that of most grasps.
    """
    differences = (a - b).reshape(len(a), -1)
    along = differences @ np.linalg.svd(differences, full_matrices=False)[2][0]
    size = np.abs(along)
    if not size.any() or np.quantile(size, 0.05) < _MIN_FINGER_DIFFERENCE * np.median(size):
        return None
    usual = 1.0 if 2 * (along > 0).sum() >= len(along) else -1.0
    return np.flatnonzero(usual * along < 0)


def check_fingers(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find grasps whose two fingers look exchanged, in the touches or in the no-contact frames."""
    for moment, selected in (("touch", grasps), ("no-contact frame", _with_backgrounds(grasps))):
        if len(selected) < _MIN_GRASPS:
            continue
        files = [grasp.touches if moment == "touch" else grasp.backgrounds for grasp in selected]
        for a, b in combinations(fingers_of(selected), 2):
            which = f"fingers {ascii_lowercase[a]} and {ascii_lowercase[b]} look"
            frames = (small_images(records, [paths[finger] for paths in files]) for finger in (a, b))
            swapped = swapped_fingers(*frames)
            if swapped is None:
                yield Finding("note", "unchecked-fingers", f"{which} too similar to find swaps ({moment})")
                continue
            names = [selected[row].grasp_id for row in swapped]
            yield from findings_for("error", "swapped-fingers", f"{which} swapped ({moment})", names, selected)


def check_moments(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find touches and no-contact frames that look exchanged.

    No-contact frames are all alike, touches are not. So a frame far from the median no-contact frame is a touch. The
    whole recording is suspect if its no-contact frames are twice as different as its touches.
    """
    both = _with_backgrounds(grasps)
    if len(both) < _MIN_GRASPS:
        return
    suspects: set[str] = set()
    for finger in fingers_of(both):
        before = small_images(records, [grasp.backgrounds[finger] for grasp in both])
        during = small_images(records, [grasp.touches[finger] for grasp in both])
        if _spread(before) > max(2 * _spread(during), _NOISE_TIMES * _MIN_NOISE):
            yield Finding(
                "error",
                "swapped-moments",
                f"touches of finger {ascii_lowercase[finger]} look swapped throughout with the no-contact frames (the "
                "no-contact frames differ from each other more than the touches do, usually it is the reverse); "
                "exchange the columns",
                tuple(grasp.grasp_id for grasp in both),
            )
            return
        no_contact, touched = (distance(frames, np.median(before, axis=0)) for frames in (before, during))
        far = _NOISE_TIMES * max(float(np.quantile(no_contact, 0.25)), _MIN_NOISE)
        suspects |= {both[row].grasp_id for row in np.flatnonzero((no_contact > far) & (touched < no_contact / 2))}
    names = [grasp.grasp_id for grasp in both if grasp.grasp_id in suspects]
    yield from findings_for("error", "swapped-moments", "touch and no-contact frame look swapped", names, both)


def changed_layout(images: SmallImages) -> tuple[str, Rows] | None:
    """Return the change in words, and the minority of images that have red and blue exchanged, or are mirrored, if any.

    The lamps of a gel give each sensor a layout of colours, which contact changes little. An image minus its changed
    version is the same for all images (n, h, w, 3) of a sensor, up to contact; in a changed image it has the other
    sign, as in `swapped_fingers`. Grey or symmetric layouts cannot be checked. Of several changes the one is returned
    that brings the minority nearest to the other images. Of two halves, the one with the first image is right.
    """
    changed: dict[float, tuple[str, Rows]] = {}  # by the ratio of distances after and before
    for change, index in CHANGES.items() if len(images) >= _MIN_GRASPS else ():
        rows = swapped_fingers(images, images[index])
        if rows is None or not len(rows):
            continue
        if 2 * len(rows) == len(images) and rows[0] == 0:
            rows = np.setdiff1d(np.arange(len(images)), rows)
        undone = images.copy()
        undone[rows] = images[rows][index]
        centre = np.median(undone, axis=0)
        ratio = float(np.median(distance(undone[rows], centre) / distance(images[rows], centre)))
        if ratio <= _MAX_RATIO:
            changed[ratio] = change, rows
    return changed[min(changed)] if changed else None


def check_colour_layout(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find gel images that have red and blue exchanged, or are mirrored, unlike the rest of the recording.

    Touches and no-contact frames of a finger are compared together.
    """
    for finger in fingers_of(grasps):
        frames = [(grasp, "no-contact frame", grasp.backgrounds[finger]) for grasp in _with_backgrounds(grasps)]
        frames += [(grasp, "touch", grasp.touches[finger]) for grasp in grasps]
        changed = changed_layout(small_images(records, [path for _, _, path in frames]))
        if changed is None:
            continue
        change, rows = changed
        for moment in ("touch", "no-contact frame"):
            names = [frames[row][0].grasp_id for row in rows if frames[row][1] == moment]
            text = f"{moment} of finger {ascii_lowercase[finger]} looks as if it had {change}, unlike the others,"
            yield from findings_for("warning", "colour-layout", text, names, grasps)
