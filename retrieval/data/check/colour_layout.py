"""Gel images of a recording whose red and blue are exchanged, or that are mirrored, unlike the others.

The lamps of a gel give each sensor a layout of colours, which contact changes little at 6 x 8 pixels. The reference is
the recording itself, so only a minority is found: if all images are exchanged or mirrored, nothing shows it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from string import ascii_lowercase

import numpy as np

from retrieval.data.check.appearance_statistics import Rows, SmallImages, distance, swapped_fingers
from retrieval.data.check.findings import Finding, ImageRecords, findings_for
from retrieval.data.dataset import Grasp

COLOUR_LAYOUT = "colour-layout"
"""Kind of these findings."""
CHANGES = {
    "red and blue exchanged": (slice(None), slice(None), slice(None), slice(None, None, -1)),
    "left and right mirrored": (slice(None), slice(None), slice(None, None, -1)),
    "top and bottom mirrored": (slice(None), slice(None, None, -1)),
}
"""Changes of images (n, h, w, 3) that leave an image unchanged if they are applied twice."""
_MAX_RATIO = 0.6
"""The change must reduce the distance to the other images at least to this fraction, in the median."""
_MIN_IMAGES = 4


@dataclass(frozen=True)
class ChangedLayout:
    """Images that fit the others better after a change.

    Attributes:
        change: The change, in words: "red and blue exchanged", for example.
        rows: Rows of these images.
    """

    change: str
    rows: Rows


def changed_layout(images: SmallImages) -> ChangedLayout | None:
    """Return the minority of images that have red and blue exchanged, or are mirrored; None if there is none.

    An image minus its changed version is the same for all images of a sensor, up to contact; in a changed image it has
    the other sign, as in `swapped_fingers`. Grey or symmetric layouts cannot be checked. Of several changes the one is
    returned that brings the minority nearest to the other images. If half of the images are changed, they are the half
    without the first image.

    Args:
        images: (n, h, w, 3) of one sensor.
    """
    found: dict[float, ChangedLayout] = {}
    for change, index in CHANGES.items():
        rows = swapped_fingers(images, images[index])
        if rows is None or not len(rows) or len(images) < _MIN_IMAGES:
            continue
        if 2 * len(rows) == len(images) and rows[0] == 0:
            rows = np.setdiff1d(np.arange(len(images)), rows)
        undone = images.copy()
        undone[rows] = images[rows][index]
        centre = np.median(undone, axis=0)
        ratio = float(np.median(distance(undone[rows], centre) / distance(images[rows], centre)))
        if ratio <= _MAX_RATIO:
            found[ratio] = ChangedLayout(change, rows)
    return found[min(found)] if found else None


def check_colour_layout(grasps: Sequence[Grasp], records: ImageRecords) -> Iterator[Finding]:
    """Find gel images that have red and blue exchanged, or are mirrored, unlike the rest of the recording.

    Touches and no-contact frames of a finger are compared together.
    """
    for finger in range(min((len(grasp.touches) for grasp in grasps), default=0)):
        before = [grasp for grasp in grasps if len(grasp.backgrounds) == len(grasp.touches)]
        frames = [(grasp, "no-contact frame", grasp.backgrounds[finger]) for grasp in before]
        frames += [(grasp, "touch", grasp.touches[finger]) for grasp in grasps]
        found = changed_layout(np.array([records[path].small for _, _, path in frames], dtype=np.float32))
        if found is None:
            continue
        for moment in ("touch", "no-contact frame"):
            names = [frames[row][0].grasp_id for row in found.rows if frames[row][1] == moment]
            text = f"{moment} of finger {ascii_lowercase[finger]} looks as if it had {found.change}, unlike the others,"
            yield from findings_for("warning", COLOUR_LAYOUT, text, names, grasps)
