"""Cylinder fit of the object on the table: position, height and radius.

A depth picture shows only one side of the object. An upright cylinder, a box and a lying cylinder (robot.sight.solids)
are fitted to the points above the table (robot.sight.cloud); the one with the smallest BIC is returned. If none is
reliable, a cruder method is used. `method` of the result names it:

    circle              robust circle through the visible side of an upright cylinder
    box                 the cylinder inscribed in a box, as for a packet
    lying               a cylinder on its side
    enclosing circle    smallest circle around the points without outliers, if the side has too few points, shows too
                        short an arc or fits no circle, or if no simple solid fits
"""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from robot.errors import PlanError
from robot.readings import RGBD, Region
from robot.sight.cloud import Rays, find_object_points, find_table
from robot.sight.solids import (
    OUTLIER_CUT,
    Array,
    Circle,
    Cuboid,
    Solid,
    UprightCylinder,
    fit_circle,
    fit_cuboid,
    fit_lying_cylinder,
    refine_circle,
)

MIN_SIDE_POINTS = 10
MIN_ARC_DEG = 60.0
_SECTOR_DEG = 10.0
_MIN_CUT_OFF_ARC_DEG = 90.0
_MAX_LOSS, _OUTLIER_MM = 0.35, 2.0


@dataclass(frozen=True)
class CylinderFit:
    """An upright cylinder on the table in the rig's frame, and the footprint of the object.

    Attributes:
        method: Method of the fit; see the top of the file.
        half_mm: Half sizes of the footprint along `yaw_rad` and across; both are the radius for a round object.
    """

    x_mm: float
    y_mm: float
    height_mm: float
    radius_mm: float
    method: str
    half_mm: tuple[float, float]
    yaw_rad: float = 0.0

    def width_mm(self, yaw_rad: float, finger_mm: float) -> float:
        """Return the smallest opening with which two fingers, `finger_mm` wide and centred, pass the object.

        For a rectangular footprint this is its extent along the closing direction `yaw_rad`, within the strip that a
        finger sweeps, in closed form.
        """
        if self.method not in ("box", "lying"):
            return 2 * self.radius_mm
        (a, b), turn, strip = self.half_mm, yaw_rad - self.yaw_rad, finger_mm / 2
        c, s = abs(math.cos(turn)), abs(math.sin(turn))
        if c * b - s * a > strip:
            # The corner lies outside the strip, so the strip's edge meets the side whose distance from the centre is a.
            return 2 * (a + s * strip) / c
        if s * a - c * b > strip:
            return 2 * (b + c * strip) / s
        return 2 * (c * a + s * b)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for the attempt log, rounded to micrometres."""
        sizes = ("x_mm", "y_mm", "height_mm", "radius_mm")
        return {name: round(getattr(self, name), 3) for name in sizes} | {"method": self.method}


def fit_cylinder(image: RGBD, extrinsics: npt.ArrayLike, region: Region | None = None) -> CylinderFit:
    """Fit a cylinder to the largest object on the table.

    Args:
        image: Picture with depth.
        extrinsics: (4, 4) camera frame to rig frame, mm, finite.
        region: Box in the rig's frame that limits the search in x and y; None for no limit.

    Raises:
        PlanError: No object is visible in depth (glass is not), or too little of it.
    """
    assert image.depth_m is not None, "a cylinder fit requires a picture with depth"
    depth = np.where(image.depth_m > 0, image.depth_m, np.nan) * np.float32(1000)
    rays = Rays.from_image(image, np.asarray(extrinsics, np.float64))
    table = find_table(depth, rays)
    points, is_cut_off = find_object_points(depth, rays, table, region)
    noise = max(1.0, table.noise_mm)
    top = _top(points, noise)
    points = points[points[:, 2] < top + OUTLIER_CUT * noise]
    best = _best_candidate(points, top, noise, rays)
    if is_cut_off and best.arc_deg < _MIN_CUT_OFF_ARC_DEG:
        raise PlanError("the object touches the border of the picture, and its visible part is too small to locate it")
    solid = best.solid
    return CylinderFit(solid.x, solid.y, solid.height, min(solid.half), best.method, solid.half, solid.yaw_rad)


@dataclass(frozen=True)
class _Candidate:
    """A fitted solid, its method, and the visible arc of a circle."""

    solid: Solid
    method: str
    arc_deg: float = 0.0


def _best_candidate(points: Array, top: float, noise: float, rays: Rays) -> _Candidate:
    eye = rays.pose[:2, 3]
    box = fit_cuboid(points, top, eye)
    lying = (fit_lying_cylinder(points, box, along, eye) for along in (True, False))
    candidates = [
        _upright_candidate(points, top, noise, rays, box),
        _Candidate(box, "box"),
        *(_Candidate(solid, "lying") for solid in lying if solid is not None),
    ]
    best = min(candidates, key=lambda candidate: candidate.solid.misfit(points, noise, rays.pose[:3, 3]))
    if best.method != "circle" and _loss(best.solid, points, noise) > _MAX_LOSS:
        return _enclosing_candidate(points, top)
    return best


def _loss(solid: Solid, points: Array, noise: float) -> float:
    """Return the mean squared distance of the points from the surface, truncated for outliers and scaled to 0..1."""
    return float((np.minimum(solid.distance(points) / (OUTLIER_CUT * noise), 1.0) ** 2).mean())


def _top(points: Array, noise: float) -> float:
    """Return the height of the uppermost dense layer; layers of outliers above it are sparse."""
    z = points[:, 2]
    layer = (z / max(4.0, noise)).astype(int)
    count = np.bincount(layer)
    usual = float(np.median(count[layer]))
    last = int(np.nonzero(count >= 0.2 * usual)[0][-1])
    fullest = int(count.argmax())
    lower = count[1 : max(fullest - 1, 1)]
    is_level = len(lower) == 0 or count[fullest] > 2 * np.median(lower)
    if fullest >= last - 3 and is_level:  # a level top, seen from above
        return float(np.median(z[np.abs(layer - fullest) <= 1]))
    return float(np.quantile(z[layer <= last], 0.99))


def _upright_candidate(points: Array, top: float, noise: float, rays: Rays, box: Cuboid) -> _Candidate:
    """Fit an upright cylinder to its visible side, or an enclosing circle if that is not sufficient."""
    side = points[points[:, 2] < top - max(4.0, noise), :2]
    if len(side) < MIN_SIDE_POINTS:
        return _enclosing_candidate(points, top)
    viewing = side.mean(0) - rays.pose[:2, 3]
    largest = 2 * math.hypot(*box.half)
    away = viewing / max(float(np.hypot(*viewing)), 1e-9)
    circle = fit_circle(side, noise, away, largest)
    if circle is None:
        return _enclosing_candidate(points, top)
    arc = _arc_deg(circle, side)
    centre = np.array([circle.x, circle.y])
    whole = refine_circle(points[:, :2], centre, circle.radius, noise, largest, away, top - points[:, 2])
    if whole is not None:
        circle = whole
    if arc < MIN_ARC_DEG or circle.inliers.sum() < MIN_SIDE_POINTS:
        return _enclosing_candidate(points, top)
    solid = UprightCylinder(circle.x, circle.y, (circle.radius, circle.radius), top)
    return _Candidate(solid, "circle", arc)


def _arc_deg(circle: Circle, side: Array) -> float:
    """Return the arc covered by points in degrees, counted in sectors."""
    on = side[circle.inliers] - [circle.x, circle.y]
    sector = np.degrees(np.arctan2(on[:, 1], on[:, 0])) // _SECTOR_DEG
    count = np.bincount(sector.astype(int) + 18, minlength=37)
    return float((count >= 2).sum() * _SECTOR_DEG)


def _enclosing_candidate(points: Array, top: float) -> _Candidate:
    """Return the smallest circle around the points in plan, without the outermost points, which may be outliers."""
    plan = points[:, :2]
    low, high = np.quantile(plan, [0.02, 0.98], axis=0)
    inner = plan[((plan > low - _OUTLIER_MM) & (plan < high + _OUTLIER_MM)).all(1)]
    (x, y), radius = cv2.minEnclosingCircle(inner.astype(np.float32))
    solid = UprightCylinder(float(x), float(y), (float(radius), float(radius)), top)
    return _Candidate(solid, "enclosing circle")
