"""Photos of simulated objects and of squares."""

import functools

import numpy as np

from retrieval.data.object_finder import find_object
from retrieval.data.resize import to_float
from retrieval.data.upright import turn
from robot.rig import load_rig


@functools.cache
def photo_of(number):
    """Return the photo (256, 256, 3) of one of the simulated rig's objects, and the object's box."""
    rig = load_rig("sim", seed=11)
    rig.prepare(rig.object_ids(number + 1)[number], 0)
    photo = to_float(np.asarray(rig.sim_state.current_scene().image("photo")))
    return photo, find_object(photo)


def rolled(number, roll_deg):
    """Return the photo (256, 256, 3) of 8 bits of one of these objects by a camera with this roll."""
    return np.rint(255 * turn(photo_of(number)[0], -roll_deg)).astype(np.uint8)


def square(number, share):
    """Return a photo (256, 256, 3) of 8 bits of a square object that takes this share of the side."""
    photo, half = np.full((256, 256, 3), 140, np.uint8), round(128 * share)
    photo[128 - half : 128 + half, 128 - half : 128 + half] = [30, 60, 180 + number]
    return photo
