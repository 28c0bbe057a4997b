"""Cylinder fit to the outline in the colour picture, for objects without depth, such as glass.

The outline contains the pixels without depth whose colour differs from the table's. Let F be the camera's foot on the
table. The vertical sides are tangents that enclose an angle 2 alpha. The lowest pixel shows the nearest point of the
base, at distance n from F. The centre lies at distance D, with n = D - r and r = D sin(alpha), so D = n / (1 - sin
alpha). The highest pixel shows the far rim of the top, at distance D + r, which gives the height.
"""

import math

import cv2
import numpy as np
import numpy.typing as npt

from robot.errors import PlanError
from robot.readings import Region
from robot.sight.cloud import Array, Depth, Mask, Patch, Rays, TablePlane, height_above, largest_patch
from robot.sight.solids import UprightCylinder

_COLOUR_LEVELS = 12.0
_MIN_PX = 60


def fit_silhouette(
    colour: npt.NDArray[np.uint8], depth_mm: Depth, rays: Rays, table: TablePlane, region: Region | None = None
) -> UprightCylinder:
    """Fit a cylinder to the largest patch without depth and of another colour than the table.

    Args:
        colour: (H, W, 3) uint8 RGB.
        depth_mm: (H, W) depth, NaN where unknown.
        rays: Rays of the pixels.
        table: The table.
        region: Box in the rig's frame that must contain the centre in x and y; None for no limit.

    Raises:
        PlanError: There is no such patch, or no cylinder on the table explains it.
    """
    patch = _patch(_differs_from_table(colour, depth_mm, rays, table) & np.isnan(depth_mm))
    rows, columns = (at + part.start for at, part in zip(patch.mask.nonzero(), patch.window, strict=True))
    directions = rays.points(np.ones(depth_mm.shape, np.float32), rows, columns) - rays.pose[:3, 3]
    return _cylinder(directions, rows, rays.pose[:3, 3] - [0.0, 0.0, table.c], region)


def _differs_from_table(colour: npt.NDArray[np.uint8], depth_mm: Depth, rays: Rays, table: TablePlane) -> Mask:
    """Return the mask of pixels whose colour differs from that of the table's pixels."""
    flat = np.abs(height_above(depth_mm, rays, table)) < max(5.0, 3 * table.noise_mm)
    if flat.sum() < 100:
        raise PlanError("the table is visible neither in depth nor in colour; check camera and light")
    smooth = cv2.GaussianBlur(colour, (5, 5), 0).astype(np.float32)
    middle = np.median(smooth[flat], axis=0)
    spread = 1.4826 * np.median(np.abs(smooth[flat] - middle), axis=0)
    return np.asarray((np.abs(smooth - middle) > np.maximum(_COLOUR_LEVELS, 5 * spread)).any(2))


def _patch(candidates: Mask) -> Patch:
    """Return the largest connected patch, with small gaps closed and single pixels removed."""
    kernel = np.ones((5, 5), np.uint8)
    closed = cv2.morphologyEx(candidates.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, kernel)
    patch = largest_patch(opened, _MIN_PX)
    if patch is None:
        raise PlanError("no object on the table in depth or colour; put the object there, or light it better")
    if patch.is_cut_off:
        raise PlanError("the object has no depth, and its outline touches the border of the picture")
    return patch


def _cylinder(directions: Array, rows: npt.NDArray[np.intp], eye: Array, region: Region | None) -> UprightCylinder:
    """Fit in closed form; see the top of the file.

    Args:
        directions: (N, 3) rays of the outline's pixels.
        rows: (N,) their rows.
        eye: (3,) position of the camera, z above the table's plane.
        region: See `fit_silhouette`.
    """
    turn = np.arctan2(directions[:, 1], directions[:, 0])
    middle = math.atan2(float(np.sin(turn).mean()), float(np.cos(turn).mean()))
    aside = (turn - middle + math.pi) % (2 * math.pi) - math.pi
    low, high = (float(value) for value in np.quantile(aside, [0.001, 0.999]))
    alpha = (high - low) / 2
    slope = -directions[:, 2] / np.hypot(directions[:, 0], directions[:, 1])
    if alpha <= 0 or slope.max() <= 0:
        raise PlanError("the outline in the colour picture does not fit an object on the table")
    near = float(eye[2] / slope.max())
    far = near / (1 - math.sin(alpha))
    radius = far * math.sin(alpha)
    height = float(eye[2] - (far + radius) * slope.min())
    yaw = middle + (low + high) / 2
    x, y = float(eye[0] + far * math.cos(yaw)), float(eye[1] + far * math.sin(yaw))
    outside = region is not None and not (
        region.lower[0] <= x <= region.upper[0] and region.lower[1] <= y <= region.upper[1]
    )
    if outside or height <= 0:
        raise PlanError("the outline in the colour picture does not fit an object on the table")
    return UprightCylinder(x, y, radius, height)
