"""The camera of a catalogue's photos where nobody stated it: its field, from the size of all objects, and its roll.

One photo does not tell its scale, and a small network is often wrong about the roll of one photo. But the photos of a
catalogue mostly come from one camera, and objects that a gripper holds have a usual size: if the objects of the whole
catalogue appear half as large as usual, the photos probably show twice as much.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from retrieval.data.images import decode, read_bytes
from retrieval.data.object_finder import INPUT_PX, find_object
from retrieval.data.upright import RollEstimator, probable_roll
from retrieval.data.views import FIELD_MM
from retrieval.errors import ImageError

USUAL_SIZE = 0.32
"""Median root of the visible area of objects, relative to the shorter side, in photos of the field `FIELD_MM`."""
FEWEST, SAMPLE = 20, 64
"""Least number of objects, and largest number of photos, from which a camera is estimated."""
_STEPS, _LEAST_STEPS = 4, 2
"""Steps in which the field doubles: it stays the same when the catalogue grows. A difference of one is ignored."""


class PhotoCamera(NamedTuple):
    """The camera of a photo.

    Attributes:
        field_mm: What the photo shows along its shorter side, at the object's distance, in millimetres.
        roll_deg: Angle in degrees by which the picture is turned anticlockwise.
    """

    field_mm: float = FIELD_MM
    roll_deg: float = 0.0


USUAL_CAMERA = PhotoCamera()


def assumed_camera(photos: Sequence[Path]) -> PhotoCamera:
    """Return the camera to assume for a catalogue's photos; USUAL_CAMERA unless they agree on another one."""
    estimator, sizes, rolls = RollEstimator(), [], []
    for path in photos[:: math.ceil(len(photos) / SAMPLE)] if photos else ():
        try:
            photo = decode(read_bytes(path), path, 2 * INPUT_PX)
        except ImageError:  # reported when the photo is encoded
            continue
        height, width = photo.shape[:2]
        found = find_object(photo)
        if found.area < height * width:
            sizes.append(math.sqrt(found.area) / min(height, width))
            rolls.append(estimator.probabilities(photo, found))
    if len(sizes) < FEWEST:
        return USUAL_CAMERA
    steps = round(_STEPS * math.log2(USUAL_SIZE / float(np.median(sizes))))
    factor = 2 ** (steps / _STEPS) if abs(steps) >= _LEAST_STEPS else 1
    return PhotoCamera(FIELD_MM * factor, probable_roll(np.mean(rolls, axis=0)))
