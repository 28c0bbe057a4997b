"""Intersection of rays with a bounding box."""

import numpy as np
from numpy.typing import NDArray

from robot.sim.jit import jit

Vectors = NDArray[np.float64]


def clip_to_box(origins: Vectors, directions: Vectors, lower: Vectors, upper: Vectors) -> tuple[Vectors, Vectors]:
    """Return where rays (n, 3) enter and leave a box, (n,) each, at least 0; a miss enters after it leaves."""
    near, far = np.empty(len(origins)), np.empty(len(origins))
    _clip(origins, directions, lower, upper, near, far)
    return near, far


@jit
def _clip(origins, directions, lower, upper, near, far):  # type: ignore[no-untyped-def]
    for number in range(len(near)):
        enters, leaves = 0.0, np.inf
        for axis in range(3):
            start, along = origins[number, axis], directions[number, axis]
            # A direction of 0 becomes tiny, so that 0 * inf cannot make NaN.
            speed = 1e-300 if abs(along) < 1e-300 else along
            one, two = (lower[axis] - start) / speed, (upper[axis] - start) / speed
            enters, leaves = max(enters, min(one, two)), min(leaves, max(one, two))
        near[number], far[number] = enters, leaves
