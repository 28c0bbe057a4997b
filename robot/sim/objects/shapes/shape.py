"""What every shape offers: a signed distance, bounds, and a chart that unrolls its wall.

A shape is the bare solid, in mm, standing on z = 0 with its axis on x = y = 0. Its distance never claims more
than there is: |d(p) - d(q)| <= |p - q|, the condition under which sphere tracing cannot pass through a surface
(Hart 1996, "Sphere tracing", theorem 1). Relief is added by `robot.sim.objects.wall`, along the chart.
"""

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.sim.objects.formula import trace_formula
from robot.sim.objects.packets import Formula, evaluate_formula

Floats = NDArray[np.float32]
Points = NDArray[np.floating]


class Chart(ABC):
    """A map of the wall: (s, t) in mm, s round the object in [0, width), t along it in [0, height]."""

    width_mm: float
    height_mm: float

    @abstractmethod
    def locate(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Map coordinates of points on or near the wall; s is periodic."""

    @abstractmethod
    def rays(self, s: Floats, t: Floats) -> tuple[Points, Points]:
        """Rays that look at the wall from outside where the map says (s, t): origins and directions (N, 3)."""


class CylindricalChart(Chart):
    """s = radius * angle about the z axis, t = z; the seam is at the back (+y)."""

    def __init__(self, radius_mm: float, height_mm: float, reach_mm: float | None = None) -> None:
        self.radius_mm = radius_mm
        self.width_mm = 2 * np.pi * radius_mm
        self.height_mm = height_mm
        self._reach_mm = radius_mm + 1 if reach_mm is None else reach_mm

    def locate(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats]:
        return (arctan2(x, -y) + np.float32(np.pi)) * np.float32(self.radius_mm), z

    def rays(self, s: Floats, t: Floats) -> tuple[Points, Points]:
        angle = s / self.radius_mm
        directions = np.stack([np.sin(angle), -np.cos(angle), np.zeros_like(s)], axis=1)
        origins = -self._reach_mm * directions
        origins[:, 2] = t
        return origins, directions


class Shape(ABC):
    """A solid by its signed distance. Subclasses set the attributes and write `_distance`."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    chart: Chart
    # The most that relief may add to or take from the surface without ruining the shape.
    relief_limit_mm: float

    @cached_property
    def formula(self) -> Formula:
        """Of `distance_xyz`, for compiled code."""
        return trace_formula(self.distance_xyz, 3)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "formula"}

    def distance(self, points: Points) -> Floats:
        """Signed distance in mm of points (N, 3), negative inside; never more than the true one."""
        return evaluate_formula(self.formula, *np.asarray(points, np.float32).T)[0]

    @abstractmethod
    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """The same for coordinates in three arrays (N,) of float32, by functions that `trace_formula` knows."""

    def wall_pattern(self, s: Floats, t: Floats) -> Floats | None:
        """Height in mm of what the shape itself wears on its wall, such as a thread: (len(t), len(s)) or None."""
        return None

    def mask(self, x: Floats, y: Floats, z: Floats) -> Floats | None:
        """Where relief belongs, 1, and where it does not, 0, such as inside a mug. None: everywhere."""
        return None

    # The steepest slope of `mask`, per mm.
    mask_slope: float = 0.0


def bounds(x: float, y: float, top: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The box [-x, x] x [-y, y] x [0, top]."""
    return np.array([-x, -y, 0.0]), np.array([x, y, top])


def relief_limit(narrow_mm: float, *others: float) -> float:
    """A sixth of the narrow width, what the gripper's 95 mm leave on each side, and 6 mm at most."""
    return max(min(6.0, narrow_mm / 6, (95 - narrow_mm) / 2, *others), 0.0)


def length(a: Floats, b: Floats) -> Floats:
    """Euclidean norm; plain, as nothing here is near overflow and np.hypot takes six times as long."""
    return np.sqrt(a * a + b * b)


def arctan2(y: Floats, x: Floats) -> Floats:
    """Angle in (-pi, pi], float32, within 2e-6 of np.arctan2, which takes five times as long.

    An odd polynomial on [0, 1], least maximal error (Hastings 1955 gives the form), and the octants.
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
    """Coefficients of arctan(r) / r in r^2 on [0, 1], through Chebyshev points."""
    nodes = (1 - np.cos(np.pi * (np.arange(64) + 0.5) / 64)) / 2
    roots = np.sqrt(nodes)
    fit = np.polynomial.Chebyshev.fit(nodes, np.arctan(roots) / roots, terms - 1, domain=[0, 1])
    return np.asarray(fit.convert(kind=np.polynomial.Polynomial).coef, np.float32)


_ARCTAN = _fit_arctan()


def smooth_min(a: Floats, b: Floats, blend_mm: float) -> Floats:
    """Minimum rounded over `blend_mm`: the quadratic smooth minimum, at most blend_mm / 4 below the sharp one.

    Its gradient is a convex mixture of the two, so that it keeps the Lipschitz bound.
    """
    if blend_mm <= 0:
        return np.minimum(a, b)
    near = np.maximum(np.float32(blend_mm) - np.abs(a - b), np.float32(0))
    blended: Floats = np.minimum(a, b) - near * near * np.float32(0.25 / blend_mm)
    return blended


def rounded_corner(a: Floats, b: Floats, radius: float) -> Floats:
    """Corner of two half-spaces with distances a and b, rounded by `radius`: exact outside and inside."""
    p, q = a + np.float32(radius), b + np.float32(radius)
    outside = length(np.maximum(p, 0), np.maximum(q, 0))
    corner: Floats = outside + np.minimum(np.maximum(p, q), 0) - np.float32(radius)
    return corner
