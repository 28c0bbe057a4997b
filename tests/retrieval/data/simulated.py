"""A photo of a simulated object."""

import functools

import numpy as np

from retrieval.data.object_finder import find_object
from retrieval.data.resize import to_float
from robot.rig import load_rig


@functools.cache
def photo_of(number):
    """Return the photo (256, 256, 3) of one of the simulated rig's objects, and the object's box."""
    rig = load_rig("sim", seed=11)
    rig.prepare(rig.object_ids(number + 1)[number], 0)
    photo = to_float(np.asarray(rig.sim_state.current_scene().image("photo")))
    return photo, find_object(photo)
