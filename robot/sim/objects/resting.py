"""Stable resting poses of a solid on the table.

A solid rests on a side of its convex hull if its centre of mass lies above the polygon of the points that touch the
table there (Goldberg 1999). Scans are not flat to a micrometre, so points within a millimetre of the table are
treated as touching.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Array = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])

_CONTACT_TOLERANCE_MM = 1.0
_MIN_TIPPING_RAD = math.radians(4.0)
"""A pose is not stable if a smaller tilt tips the solid over."""

_SAME_COSINE = math.cos(math.radians(20.0))
"""Sides with normals closer than this are treated as one side; its most stable pose is used."""

_MAX_POSES = 6


def stable_up_directions(vertices: Array, centre_of_mass: Array) -> list[Array]:
    """Return directions (3,) of the solid that point up at rest: its own z or one near it first, then the most stable.

    There are at most 6 directions; only its own z if no pose is stable.
    """
    hull = ConvexHull(vertices)
    corners = vertices[hull.vertices] - centre_of_mass
    # Scans have thousands of sides. Try one of those that point the same way to about a degree.
    _, first = np.unique(np.rint(hull.equations[:, :3] / 0.02), axis=0, return_index=True)
    candidates = [UP, *-hull.equations[np.sort(first), :3]]
    angles = [tipping_angle(corners, -up) for up in candidates]
    stable = sorted((number == 0, angle, number) for number, angle in enumerate(angles) if angle > _MIN_TIPPING_RAD)
    poses: list[Array] = []
    for up in (candidates[number] for *_, number in reversed(stable)):
        if all(up @ other < _SAME_COSINE for other in poses):
            poses.append(up)
    return sorted(poses, key=lambda up: bool(up @ UP < _SAME_COSINE))[:_MAX_POSES] or [UP]  # upright ones first


def tipping_angle(corners: Array, down: Array) -> float:
    """Return how far (rad) a solid can be tilted before it tips over; below 0 if it does not rest.

    `corners` (N, 3) are those of its convex hull from the centre of mass; `down` (3,) is the direction of the table.
    """
    depth = corners @ down
    height = float(depth.max())
    touching = corners[depth >= height - _CONTACT_TOLERANCE_MM] @ rotation_to_up(-down).T
    try:
        edges = ConvexHull(touching[:, :2]).equations if len(touching) > 2 else None
    except QhullError:  # the points are collinear
        edges = None
    return -1.0 if edges is None else math.atan2(-float(edges[:, 2].max()), height)


def rotation_to_up(up: Array) -> Array:
    """Return the shortest rotation (3, 3) that maps the unit direction `up` (3,) to z."""
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + z))
