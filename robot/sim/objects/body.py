"""What rays meet: the contract of a body, and bodies given by a signed distance and a baked relief.

Frame: the object's, in mm, z up, base at z = 0. Camera and gel see the same geometry through `Body.cast`.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.errors import SceneError
from robot.sim.objects.relief import Relief
from robot.sim.objects.shapes.base import Floats, Points, Shape
from robot.sim.objects.wall import Level, Wall, bake

Vectors = NDArray[np.float64]
GEL_STEP_MM = 0.1
_MOST_STEPS = 600


@dataclass(frozen=True)
class ClippedRays:
    """Rays cut to the bounding box: they start `near_mm` from where they were asked for and end after `far_mm`."""

    origins: Vectors
    directions: Vectors
    near_mm: Vectors
    far_mm: Vectors
    step_mm: float
    beyond_mm: float


class Body(ABC):
    """A solid that can be seen and touched. Subclasses set the bounds and write `_cast` and `_normals`."""

    lower: Vectors
    upper: Vectors

    def cast(
        self, origins: Points, directions: Points, step_mm: float = GEL_STEP_MM, beyond_mm: float = math.inf
    ) -> Vectors:
        """Distance in mm along each ray to the first hit, (N,) float64, inf for a miss.

        `origins`, `directions`: (N, 3), directions of unit length; a ray that starts inside hits at 0.
        `step_mm`: the finest detail that matters; a camera gives the size of its pixel on the object, and is served
        faster. `beyond_mm`: hits further than this behind the nearest one may be given as misses; a gel that is
        pressed a few mm deep never meets them. Raises SceneError.
        """
        start, along = _checked(origins, directions)
        near, far = _slab(start, along, self.lower, self.upper)
        inside = np.flatnonzero(near <= far)
        distances = np.full(len(start), np.inf)
        if len(inside):
            start, along, near = start[inside], along[inside], near[inside]
            entry = start + near[:, None] * along
            distances[inside] = near + self._cast(
                ClippedRays(entry, along, near, far[inside] - near, step_mm, beyond_mm)
            )
        return distances

    def normals(self, points: Points, step_mm: float = GEL_STEP_MM) -> Vectors:
        """Outward unit normals (N, 3) at points (N, 3) on the surface, relief included, smoothed over `step_mm`."""
        array = np.asarray(points, np.float64)
        if array.ndim != 2 or array.shape[1] != 3:
            raise SceneError(f"points must be an array of shape (N, 3), got {array.shape}")
        gradient = self._normals(array, step_mm)
        size = np.linalg.norm(gradient, axis=1, keepdims=True)
        return np.where(size > 0, gradient / np.where(size > 0, size, 1), [0.0, 0.0, 1.0])

    @abstractmethod
    def volumes_mm3(self, shell_mm: float) -> tuple[float, float]:
        """Volume of the solid, and of its outermost `shell_mm` alone."""

    @abstractmethod
    def _cast(self, rays: ClippedRays) -> Vectors:
        """Distances from the rays' origins on the bounding box; inf for a miss."""

    @abstractmethod
    def _normals(self, points: Vectors, step_mm: float) -> Vectors:
        """Outward normals of any length."""


def _checked(origins: Points, directions: Points) -> tuple[Vectors, Vectors]:
    start, along = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    if start.ndim != 2 or start.shape[1] != 3 or start.shape != along.shape:
        raise SceneError(f"rays must be two arrays of shape (N, 3), got {start.shape} and {along.shape}")
    # One sum finds NaN and infinity, as either spreads.
    if not np.isfinite(start.sum()):
        raise SceneError("ray origins must be finite")
    square = np.einsum("ij,ij->i", along, along)
    if not np.all(np.abs(square - 1) < 1e-4):
        raise SceneError("ray directions must be of unit length; divide each by its norm")
    return start, along


def _slab(start: Vectors, along: Vectors, lower: Vectors, upper: Vectors) -> tuple[Vectors, Vectors]:
    """Where rays enter and leave the box, at least 0; a miss enters after it leaves."""
    near, far = np.zeros(len(start)), np.full(len(start), np.inf)
    for axis in range(3):
        # A direction of 0 becomes tiny, so that 0 * inf cannot make NaN.
        speed = np.where(np.abs(along[:, axis]) < 1e-300, 1e-300, along[:, axis])
        one, two = (lower[axis] - start[:, axis]) / speed, (upper[axis] - start[:, axis]) / speed
        np.maximum(near, np.minimum(one, two), out=near)
        np.minimum(far, np.maximum(one, two), out=far)
    return near, far


class SdfBody(Body):
    """A shape whose surface is displaced outwards by its relief: the zero of f = distance - height."""

    def __init__(self, shape: Shape, relief: Relief) -> None:
        self.shape, self.relief = shape, relief
        out = 0.0 if relief.engraved else relief.amplitude_mm
        outwards = np.array([out, out, 0.0])
        self.lower, self.upper = shape.lower - outwards, shape.upper + outwards

    @cached_property
    def wall(self) -> Wall | None:
        """The baked relief; None for a bare shape. Drawn when first used, not pickled."""
        return bake(self.shape, self.relief)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "wall"}

    def volumes_mm3(self, shell_mm: float) -> tuple[float, float]:
        """Counted on a grid of 28^3 cells, relief left out: within some 3 % of the true volume."""
        axes = [low + (high - low) * (np.arange(28) + 0.5) / 28 for low, high in zip(*self._bare, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        distance = self.shape.distance(grid)
        cell = float(np.prod(self._bare[1] - self._bare[0])) / len(grid)
        return cell * int((distance < 0).sum()), cell * int(((distance < 0) & (distance > -shell_mm)).sum())

    @property
    def _bare(self) -> tuple[Vectors, Vectors]:
        return self.shape.lower, self.shape.upper

    def field(self, x: Floats, y: Floats, z: Floats, step_mm: float = GEL_STEP_MM) -> Floats:
        """f in mm at points in float32: below 0 inside, above 0 outside; near the surface close to the distance."""
        base = self.shape.distance_xyz(x, y, z)
        level = self._level(step_mm)
        return base if level is None else base - self._height(level, x, y, z)

    def _level(self, step_mm: float) -> Level | None:
        return self.wall.level(step_mm) if self.wall else None

    def _height(self, level: Level, x: Floats, y: Floats, z: Floats) -> Floats:
        height = level.at(*self.shape.chart.locate(x, y, z))
        mask = self.shape.mask(x, y, z)
        return height if mask is None else height * mask

    def _normals(self, points: Vectors, step_mm: float) -> Vectors:
        """Differences over the corners of a tetrahedron: four evaluations of f instead of six."""
        total = np.zeros_like(points)
        x, y, z = np.ascontiguousarray(points.T, np.float32)
        for corner in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
            a, b, c = (np.float32(step_mm / 2 * sign) for sign in corner)
            total += self.field(x + a, y + b, z + c, step_mm)[:, None] * np.array(corner, np.float64)
        return total

    def _cast(self, rays: ClippedRays) -> Vectors:
        lines = np.ascontiguousarray(np.concatenate([rays.origins, rays.directions], axis=1).T, np.float32)
        brackets = self._march(lines, rays)
        hits = np.flatnonzero(np.isfinite(brackets[0]))
        distances = np.full(len(rays.near_mm), np.inf)
        distances[hits] = self._refine(lines[:, hits], brackets[:, hits], rays.step_mm)
        return distances

    def _march(self, lines: Floats, rays: ClippedRays) -> Floats:
        """Sphere tracing until f changes sign: rows t and f just inside (inf: a miss), t and f just outside.

        Outside the shell that relief can reach, the step is the distance to it. Within, f / L is safe (L bounds
        the slope of f), and no step is shorter than a stride: what that could jump is thinner than `step_mm` asks.
        """
        level, near, far = self._level(rays.step_mm), rays.near_mm.astype(np.float32), rays.far_mm.astype(np.float32)
        highest, bound = (np.float32(level.highest_mm), np.float32(1 + level.slope)) if level else (_ZERO, _ONE)
        found = np.full((4, len(far)), np.inf, np.float32)
        active, t, last = np.arange(len(far)), np.zeros(len(far), np.float32), np.zeros((2, len(far)), np.float32)
        for number in range(_MOST_STEPS):
            x, y, z = lines[:3] + t * lines[3:]
            gap = self.shape.distance_xyz(x, y, z) - highest
            f = gap if level is None else self._worn(level, gap, x, y, z)
            crossed = f <= 0
            if crossed.any():
                found[:, active[crossed]] = np.stack([t, f, *last])[:, crossed]
                far = np.minimum(far, (near + t)[crossed].min() + np.float32(rays.beyond_mm) - near)
            stride = np.float32(_stride(rays.step_mm, number))
            forward = np.maximum(gap, f / bound) + (gap > 0) * stride
            # Outside the shell f is not known: 0 asks for it to be worked out.
            last = np.stack([t + np.maximum(gap, 0), np.where(gap > 0, 0, f)])
            t = t + np.maximum(stride, forward)
            keep = np.flatnonzero(~crossed & (last[0] <= far))
            if not len(keep):
                break
            if len(keep) < len(active):
                active, t, near, far = active[keep], t[keep], near[keep], far[keep]
                last, lines = last[:, keep], lines[:, keep]
        return found

    def _worn(self, level: Level, gap: Floats, x: Floats, y: Floats, z: Floats) -> Floats:
        """f where relief can reach, elsewhere the distance to where it can."""
        near = np.flatnonzero(gap <= 0)
        if not len(near):
            return gap
        if len(near) > 0.8 * len(gap):
            return np.where(gap > 0, gap, gap + np.float32(level.highest_mm) - self._height(level, x, y, z))
        f = gap.copy()
        f[near] += np.float32(level.highest_mm) - self._height(level, x[near], y[near], z[near])
        return f

    def _refine(self, lines: Floats, brackets: Floats, step_mm: float) -> Floats:
        """Close in on the zero between a point outside and one inside, by false position."""
        high, f_high, low, f_low = brackets
        blind = np.flatnonzero(f_low == 0)
        if len(blind):
            x, y, z = lines[:3, blind] + low[blind] * lines[3:, blind]
            f_low[blind] = self.field(x, y, z, step_mm)
        for _ in range(2):
            middle = low + _zero_between(f_low, f_high) * (high - low)
            x, y, z = lines[:3] + middle * lines[3:]
            f = self.field(x, y, z, step_mm)
            out = f > 0
            low, f_low = np.where(out, middle, low), np.where(out, f, f_low)
            high, f_high = np.where(out, high, middle), np.where(out, f_high, f)
        return np.asarray(low + _zero_between(f_low, f_high) * (high - low))


_ZERO, _ONE = np.float32(0), np.float32(1)


def _zero_between(f_low: Floats, f_high: Floats) -> Floats:
    """Where the chord from f_low > 0 to f_high <= 0 meets 0, as a share of the way."""
    return np.asarray(np.clip(f_low / np.maximum(f_low - f_high, np.float32(1e-9)), 0, 1))


def _stride(step_mm: float, number: int) -> float:
    """Shortest step of a ray: half the finest detail; rays that graze for long walk up to four times as fast."""
    return 0.5 * step_mm * float(np.clip(number / 40, 1, 4))
