"""Geometry of objects: the base class Body, and bodies from a signed distance and a baked relief.

Frame: the object's, in mm, z up, base at z = 0. Camera and gel use the same geometry through `Body.cast`.
"""

import math
from abc import ABC, abstractmethod
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot.sim.objects.formula import trace_formula
from robot.sim.objects.packets import DisplacedSolid, Formula, Rays, ReliefLevel, first_hits, gradients, hits
from robot.sim.objects.relief import Relief
from robot.sim.objects.shapes.shape import Floats, Points, Shape
from robot.sim.objects.wall import bake, level_of

Vectors = NDArray[np.float64]
GEL_STEP_MM = 0.1


class Body(ABC):
    """Base class of solids. Subclasses set the bounds and write `_cast` and `_normals`."""

    lower: Vectors
    upper: Vectors

    def cast(self, origins: Points, directions: Points, step_mm: float = GEL_STEP_MM) -> Vectors:
        """Return the distance in mm along each ray to the first hit, (N,) float64, inf for a miss.

        Args:
            origins: (N, 3) start points; a ray that starts inside hits at 0.
            directions: (N, 3) unit vectors.
            step_mm: finest detail of interest. A camera passes the size of its pixel on the object, which is faster.
        """
        return self._cast(self._clip_rays(origins, directions), step_mm)

    def hit(self, origins: Points, directions: Points, step_mm: float = GEL_STEP_MM) -> NDArray[np.bool_]:
        """Return which rays hit, (N,), without the distance."""
        return self._hit(self._clip_rays(origins, directions), step_mm)

    def _clip_rays(self, origins: Points, directions: Points) -> Rays:
        start, along = _contiguous(origins), _contiguous(directions)
        return Rays(start, along, *clip_to_box(start, along, self.lower, self.upper))

    def normals(self, points: Points, step_mm: float = GEL_STEP_MM) -> Vectors:
        """Return the outward unit normals (N, 3) at surface points (N, 3), with relief, smoothed over `step_mm`."""
        gradient = self._normals(_contiguous(points), step_mm)
        size = np.linalg.norm(gradient, axis=1, keepdims=True)
        return np.where(size > 0, gradient / np.where(size > 0, size, 1), [0.0, 0.0, 1.0])

    @abstractmethod
    def volumes_mm3(self, shell_mm: float) -> tuple[float, float]:
        """Return the volume of the solid, and the volume of its outermost `shell_mm`."""

    @abstractmethod
    def _cast(self, rays: Rays, step_mm: float) -> Vectors:
        """Return distances from the rays' origins, (N,); inf for a miss."""

    def _hit(self, rays: Rays, step_mm: float) -> NDArray[np.bool_]:
        """Return whether there is a hit, (N,); a subclass may find this without the distance."""
        return np.isfinite(self._cast(rays, step_mm))

    @abstractmethod
    def _normals(self, points: Vectors, step_mm: float) -> Vectors:
        """Return outward normals of any length."""


def clip_to_box(origins: Vectors, directions: Vectors, lower: Vectors, upper: Vectors) -> tuple[Vectors, Vectors]:
    """Return where rays (n, 3) enter and leave a box, (n,) each, at least 0; a miss enters after it leaves."""
    start, along = np.ascontiguousarray(origins.T), np.ascontiguousarray(directions.T)
    # A direction of 0 becomes tiny, so that 0 * inf cannot make NaN.
    speed = np.where(np.abs(along) < 1e-300, 1e-300, along)
    one, two = (lower[:, None] - start) / speed, (upper[:, None] - start) / speed
    return np.maximum(np.minimum(one, two).max(axis=0), 0.0), np.maximum(one, two).min(axis=0)


def _contiguous(array: Points) -> Vectors:
    """Return a C-contiguous float64 array, so that packets are compiled for one layout."""
    return np.require(array, np.float64, ["C", "W"])


class SdfBody(Body):
    """A shape whose surface is displaced outwards by its relief: the zero of f = distance - height."""

    def __init__(self, shape: Shape, relief: Relief) -> None:
        self.shape, self.relief = shape, relief
        out = 0.0 if relief.engraved else relief.amplitude_mm
        outwards = np.array([out, out, 0.0])
        self.lower, self.upper = shape.lower - outwards, shape.upper + outwards

    @cached_property
    def wall(self) -> list[ReliefLevel]:
        """The baked relief, from fine to coarse; empty for a smooth shape. Computed on first use."""
        return bake(self.shape, self.relief)

    @cached_property
    def _chart_formula(self) -> Formula:
        return trace_formula(self.chart_coordinates, 3)

    def chart_coordinates(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the chart coordinates of a point, and the weight of relief there."""
        mask = self.shape.mask(x, y, z)
        return *self.shape.chart.locate(x, y, z), np.full_like(x, 1.0) if mask is None else mask

    def volumes_mm3(self, shell_mm: float) -> tuple[float, float]:
        """Count cells on a 28^3 grid, without relief: within about 3 % of the true volume."""
        lower, upper = self.shape.lower, self.shape.upper
        axes = [low + (high - low) * (np.arange(28) + 0.5) / 28 for low, high in zip(lower, upper, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        distance = self.shape.distance(grid)
        cell = float(np.prod(upper - lower)) / len(grid)
        return cell * int((distance < 0).sum()), cell * int(((distance < 0) & (distance > -shell_mm)).sum())

    def field(self, x: Floats, y: Floats, z: Floats, step_mm: float = GEL_STEP_MM) -> Floats:
        """Return f in mm at float32 points: below 0 inside, above 0 outside; near the surface close to the distance.

        This is plain numpy; rays use compiled formulas of the same functions.
        """
        base = self.shape.distance_xyz(x, y, z)
        if not self.wall:
            return base
        s, t, weight = self.chart_coordinates(x, y, z)
        return base - level_of(self.wall, step_mm).at(s, t) * weight

    def displaced_solid(self, step_mm: float) -> DisplacedSolid:
        """Return the body as compiled formulas and arrays, at the relief level for detail of `step_mm`."""
        level = level_of(self.wall, step_mm) if self.wall else _NO_RELIEF
        return DisplacedSolid(self.shape.formula, self._chart_formula, level)

    def _normals(self, points: Vectors, step_mm: float) -> Vectors:
        return gradients(self.displaced_solid(step_mm), points, step_mm)

    def _cast(self, rays: Rays, step_mm: float) -> Vectors:
        return first_hits(self.displaced_solid(step_mm), rays, step_mm)

    def _hit(self, rays: Rays, step_mm: float) -> NDArray[np.bool_]:
        return hits(self.displaced_solid(step_mm), rays, step_mm)


_NO_RELIEF = ReliefLevel(np.zeros((0, 0), np.float32), 1.0, 1.0, 0.0, 0.0, math.inf)
