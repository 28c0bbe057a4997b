"""Intersection of rays with a bounding box."""

import numpy as np
from numpy.typing import NDArray

from robot.errors import SceneError
from robot.sim.jit import jit

Vectors = NDArray[np.float64]


def clip_to_box(origins: Vectors, directions: Vectors, lower: Vectors, upper: Vectors) -> tuple[Vectors, Vectors]:
    """Return where rays (n, 3) enter and leave a box, (n,) each, at least 0; a miss enters after it leaves.

    Raises:
        SceneError: An origin is not finite, or a direction is not of unit length.
    """
    near, far = np.empty(len(origins)), np.empty(len(origins))
    reason = _clip(origins, directions, lower, upper, near, far)
    if reason:
        raise SceneError(reason)
    return near, far


@jit
def _clip(origins, directions, lower, upper, near, far):  # type: ignore[no-untyped-def]
    """Fill near and far; return the reason if a ray is invalid, else an empty string."""
    for number in range(len(near)):
        enters, leaves, square = 0.0, np.inf, 0.0
        for axis in range(3):
            start, along = origins[number, axis], directions[number, axis]
            if not np.isfinite(start):
                return "ray origins must be finite"
            square += along * along
            # A direction of 0 becomes tiny, so that 0 * inf cannot make NaN.
            speed = 1e-300 if abs(along) < 1e-300 else along
            one, two = (lower[axis] - start) / speed, (upper[axis] - start) / speed
            enters, leaves = max(enters, min(one, two)), min(leaves, max(one, two))
        if not abs(square - 1) < 1e-4:
            return "ray directions must be of unit length; divide each by its norm"
        near[number], far[number] = enters, leaves
    return ""
