"""Base classes of shapes: a signed distance, bounds, and a chart that unrolls the wall.

A shape is the smooth solid, in mm, on z = 0 with its axis on x = y = 0. Its distance function satisfies |d(p) - d(q)|
<= |p - q|, the condition under which sphere tracing cannot pass through a surface (Hart 1996, "Sphere tracing", theorem
1). `robot.sim.objects.wall` adds relief along the chart.
"""

from abc import ABC, abstractmethod
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot.sim.objects.formula import trace_formula
from robot.sim.objects.packets import Formula, evaluate_formula

Floats = NDArray[np.float32]
Points = NDArray[np.floating]


class Chart(ABC):
    """A map of the wall: (s, t) in mm, s around the object in [0, width), t along it in [0, height]."""

    width_mm: float
    height_mm: float

    @abstractmethod
    def locate(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Return map coordinates of points on or near the wall; s is periodic."""

    @abstractmethod
    def rays(self, s: Floats, t: Floats) -> tuple[Points, Points]:
        """Return rays towards the wall from outside, at map coordinates (s, t): origins and directions (N, 3)."""


class CylindricalChart(Chart):
    """s = radius * angle about the z axis, t = z; the seam is at the back (+y)."""

    def __init__(self, radius_mm: float, height_mm: float, reach_mm: float | None = None) -> None:
        self.radius_mm = radius_mm
        self.width_mm = 2 * np.pi * radius_mm
        self.height_mm = height_mm
        self._reach_mm = radius_mm + 1 if reach_mm is None else reach_mm

    def locate(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Return map coordinates of points on or near the wall."""
        return (arctan2(x, -y) + np.float32(np.pi)) * np.float32(self.radius_mm), z

    def rays(self, s: Floats, t: Floats) -> tuple[Points, Points]:
        """Return horizontal rays towards the axis, at map coordinates (s, t)."""
        angle = s / self.radius_mm
        directions = np.stack([np.sin(angle), -np.cos(angle), np.zeros_like(s)], axis=1)
        origins = -self._reach_mm * directions
        origins[:, 2] = t
        return origins, directions


class Shape(ABC):
    """A solid defined by its signed distance. Subclasses set the attributes and write `distance_xyz`."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    chart: Chart
    # Greatest height or depth of relief that keeps the shape recognisable.
    relief_limit_mm: float

    @cached_property
    def formula(self) -> Formula:
        """Formula of `distance_xyz`, for compiled code."""
        return trace_formula(self.distance_xyz, 3)

    def distance(self, points: Points) -> Floats:
        """Return the signed distance in mm of points (N, 3), negative inside; never more than the true one."""
        return evaluate_formula(self.formula, *np.asarray(points, np.float32).T)[0]

    @abstractmethod
    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return the signed distance for coordinates in three float32 arrays (N,); see `trace_formula`."""

    def wall_pattern(self, s: Floats, t: Floats) -> Floats | None:
        """Return the shape's own pattern on its wall in mm, such as a thread: (len(t), len(s)) or None."""
        return None

    def mask(self, x: Floats, y: Floats, z: Floats) -> Floats | None:
        """Return the weight of relief, 1 to 0, such as 0 inside a mug; None for 1 everywhere."""
        return None

    # Greatest slope of `mask`, per mm.
    mask_slope: float = 0.0


def bounds(x: float, y: float, top: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the box [-x, x] x [-y, y] x [0, top]."""
    return np.array([-x, -y, 0.0]), np.array([x, y, top])


def relief_limit(narrow_mm: float, *others: float) -> float:
    """Return the relief limit: a sixth of the narrow width, the free space in the 95 mm gripper, at most 6 mm."""
    return max(min(6.0, narrow_mm / 6, (95 - narrow_mm) / 2, *others), 0.0)


def length(a: Floats, b: Floats) -> Floats:
    """Return the Euclidean norm; plain, because nothing here is near overflow and np.hypot takes six times as long."""
    return np.sqrt(a * a + b * b)


def arctan2(y: Floats, x: Floats) -> Floats:
    """Return the angle in (-pi, pi], float32, within 2e-6 of np.arctan2, which takes five times as long.

    An odd polynomial on [0, 1] of least maximal error (the form is from Hastings 1955), extended by octants.
    """
    a, b = np.abs(x), np.abs(y)
    ratio = np.minimum(a, b) / np.maximum(np.maximum(a, b), np.float32(1e-30))
    square = ratio * ratio
    angle = np.full_like(ratio, _ARCTAN[-1])
    for factor in _ARCTAN[-2::-1]:
        angle *= square
        angle += factor
    angle *= ratio
    angle += (b > a) * (np.float32(np.pi / 2) - 2 * angle)
    angle += (x < 0) * (np.float32(np.pi) - 2 * angle)
    return np.copysign(angle, y)


def _fit_arctan(terms: int = 8) -> NDArray[np.float32]:
    """Fit coefficients of arctan(r) / r in r^2 on [0, 1], through Chebyshev points."""
    nodes = (1 - np.cos(np.pi * (np.arange(64) + 0.5) / 64)) / 2
    roots = np.sqrt(nodes)
    fit = np.polynomial.Chebyshev.fit(nodes, np.arctan(roots) / roots, terms - 1, domain=[0, 1])
    return np.asarray(fit.convert(kind=np.polynomial.Polynomial).coef, np.float32)


_ARCTAN = _fit_arctan()


def smooth_min(a: Floats, b: Floats, blend_mm: float) -> Floats:
    """Return the minimum rounded over `blend_mm`.

    This quadratic smooth minimum is at most blend_mm / 4 below the sharp one. Its gradient is a convex combination of
    the two gradients, so it keeps the Lipschitz bound.
    """
    if blend_mm <= 0:
        return np.minimum(a, b)
    near = np.maximum(np.float32(blend_mm) - np.abs(a - b), np.float32(0))
    blended: Floats = np.minimum(a, b) - near * near * np.float32(0.25 / blend_mm)
    return blended


def rounded_corner(a: Floats, b: Floats, radius: float) -> Floats:
    """Return the distance to the rounded corner of two half-spaces at distances a and b: exact outside and inside."""
    p, q = a + np.float32(radius), b + np.float32(radius)
    outside = length(np.maximum(p, 0), np.maximum(q, 0))
    corner: Floats = outside + np.minimum(np.maximum(p, q), 0) - np.float32(radius)
    return corner
