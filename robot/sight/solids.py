"""Fits of three solids on a table to one-sided noisy points: upright cylinder, box, lying cylinder.

Points are (N, 3) in mm with z above the table. The BIC compares the solids by the distance of each point from the
surface. A solid is a product of intervals and discs: with q the signed distances beyond each pair of faces, the
distance is |max q| inside and the norm of max(q, 0) outside.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

OUTLIER_CUT = 3.0
"""Residuals are truncated at this multiple of the noise; points beyond are outliers of equal cost."""
_SPACING_MM = 6.0
"""Spacing of some 300 points on an object of usual size, the resolution of the visibility test."""
_HYPOTHESES = 200
_MAX_ITERATIONS = 12
_NEAR_SIDE = 0.3
"""Points of a visible side lie at most this fraction of the radius behind the centre; it leaves room for noise."""


@dataclass(frozen=True)
class Solid(ABC):
    """A solid on the table: its centre and its half sizes in plan, along `yaw_rad` and across, and its height."""

    x: float
    y: float
    half: tuple[float, float]
    height: float
    yaw_rad: float = 0.0
    parameters: ClassVar[int]

    @abstractmethod
    def face_distances(self, points: Array) -> tuple[Array, ...]:
        """Return the signed distances (N,) of points beyond each pair of faces, negative between them."""

    def distance(self, points: Array) -> Array:
        """Return the (N,) distances of points from the surface."""
        q = np.stack(self.face_distances(points))
        outside = np.sqrt((np.maximum(q, 0.0) ** 2).sum(0))
        return np.asarray(np.where(outside > 0, outside, -q.max(0)))

    @abstractmethod
    def local_surface(self) -> tuple[Array, Array]:
        """Return (M, 3) points on the surface except its bottom, and their outward normals, in the solid's frame."""

    def misfit(self, points: Array, noise_mm: float, eye: Array) -> float:
        """Return the Bayesian information criterion with truncated residuals, for a camera at eye (3,).

        It also counts visible surface without points: else a solid could extend far behind the points.
        """
        squared = np.minimum((self.distance(points) / noise_mm) ** 2, OUTLIER_CUT**2)
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        local, directions = self.local_surface()
        surface, normals = local @ turn + [self.x, self.y, 0.0], directions @ turn
        facing = surface[((eye - surface) * normals).sum(1) > 0]
        nearest = ((facing[:, None] - _subsample(points)) ** 2).sum(-1).min(1)
        missed = np.minimum(nearest / max(noise_mm, _SPACING_MM) ** 2, OUTLIER_CUT**2)
        return float(squared.sum() + len(points) * missed.mean()) + self.parameters * math.log(len(points))


class UprightCylinder(Solid):
    """A cylinder that stands on its base."""

    parameters = 4

    def face_distances(self, points: Array) -> tuple[Array, ...]:
        """Return the distances beyond the side, and beyond bottom and top."""
        rho = np.hypot(points[:, 0] - self.x, points[:, 1] - self.y)
        return rho - self.half[0], np.abs(points[:, 2] - self.height / 2) - self.height / 2

    def local_surface(self) -> tuple[Array, Array]:
        """Return points and normals of the side and the top."""
        angle, z = _grid(np.linspace(0, 2 * math.pi, 20, endpoint=False), np.linspace(0.1, 1.0, 6) * self.height)
        c, s, flat, radius = np.cos(angle), np.sin(angle), np.zeros_like(angle), self.half[0]
        side = np.stack([radius * c, radius * s, z], axis=1)
        ring = z / self.height  # the same grid gives the rings of the top
        top = np.stack([radius * ring * c, radius * ring * s, flat + self.height], axis=1)
        normals = [np.stack([c, s, flat], axis=1), np.stack([flat, flat, flat + 1], axis=1)]
        return np.concatenate([side, top]), np.concatenate(normals)


class Cuboid(Solid):
    """A box that stands on a face."""

    parameters = 6

    def face_distances(self, points: Array) -> tuple[Array, ...]:
        """Return the distances beyond the ends, beyond the sides, and beyond bottom and top."""
        along, across = rotate_plan(points[:, :2] - [self.x, self.y], self.yaw_rad).T
        z = np.abs(points[:, 2] - self.height / 2) - self.height / 2
        return np.abs(along) - self.half[0], np.abs(across) - self.half[1], z

    def local_surface(self) -> tuple[Array, Array]:
        """Return points and normals of the four sides and the top."""
        u, v = _grid(np.linspace(-1, 1, 7), np.linspace(-1, 1, 7))
        end, up = np.ones_like(u), 0.55 + 0.45 * v  # without the lowest tenth, next to the table
        faces = [(end, u, up), (-end, u, up), (u, end, up), (u, -end, up), (u, v, end)]
        points = np.concatenate([np.stack(face, axis=1) for face in faces]) * [*self.half, self.height]
        return points, np.repeat([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], len(u), axis=0)


class LyingCylinder(Solid):
    """A cylinder on its side; its half sizes are half its length and its radius."""

    parameters = 5

    def face_distances(self, points: Array) -> tuple[Array, ...]:
        """Return the distances beyond the round side and beyond the ends."""
        half_length, radius = self.half
        along, across = rotate_plan(points[:, :2] - [self.x, self.y], self.yaw_rad).T
        return np.hypot(across, points[:, 2] - radius) - radius, np.abs(along) - half_length

    def local_surface(self) -> tuple[Array, Array]:
        """Return points and normals of the round side and the ends."""
        half_length, radius = self.half
        angle, u = _grid(np.linspace(0, 2 * math.pi, 20, endpoint=False), np.linspace(-1, 1, 7))
        c, s, flat = radius * np.cos(angle), radius * np.sin(angle), np.zeros_like(angle)
        side = np.stack([half_length * u, c, s + radius], axis=1)
        end = np.stack([half_length * np.sign(u), u * c, u * s + radius], axis=1)
        normals = [np.stack([flat, c, s], axis=1), np.stack([np.sign(u), flat, flat], axis=1)]
        return np.concatenate([side, end]), np.concatenate(normals)


def _grid(first: Array, second: Array) -> tuple[Array, Array]:
    """Return all pairs, flattened."""
    a, b = np.meshgrid(first, second)
    return a.ravel(), b.ravel()


def rotate_plan(plan: Array, yaw_rad: float) -> Array:
    """Return the (N, 2) coordinates along and across the direction of yaw."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.asarray(plan @ np.array([[c, -s], [s, c]]))


@dataclass(frozen=True)
class Circle:
    """A circle in plan, and the mask (N,) of the points that it was fitted to."""

    x: float
    y: float
    radius: float
    inliers: npt.NDArray[np.bool_]


def fit_circle(plan: Array, noise_mm: float, away: Array, largest_mm: float) -> Circle | None:
    """Fit a robust geometric circle to an arc visible from outside; return None if none is found.

    RANSAC over three points with truncated squares, then `refine_circle`.

    Args:
        plan: (N, 2) points.
        noise_mm: Noise of the points.
        away: (2,) viewing direction; the centre lies behind the arc.
        largest_mm: Upper limit of the radius.
    """
    rng = np.random.default_rng(0)
    some = _subsample(plan)
    a, b, c = np.moveaxis(some[rng.integers(len(some), size=(_HYPOTHESES, 3))], 1, 0)
    centres, radii = _circles_through(a, b, c)
    good = np.isfinite(radii) & (radii < largest_mm) & ((centres - some.mean(0)) @ away > 0)
    if not good.any():
        return None
    centres, radii = centres[good], radii[good]
    gap = np.linalg.norm(centres[:, None] - some, axis=-1) - radii[:, None]
    behind = (some @ away)[None] - (centres @ away)[:, None] > _NEAR_SIDE * radii[:, None]
    cost = np.where(behind, OUTLIER_CUT**2, np.minimum((gap / noise_mm) ** 2, OUTLIER_CUT**2))
    best = int(cost.sum(1).argmin())
    return refine_circle(plan, centres[best], float(radii[best]), noise_mm, largest_mm, away)


def refine_circle(
    plan: Array,
    centre: Array,
    radius: float,
    noise_mm: float,
    largest_mm: float,
    away: Array,
    below: Array | None = None,
) -> Circle | None:
    """Refine a circle by Gauss-Newton with Tukey's weights on |p - c| - r; return None if the steps diverge.

    Points on the side that faces away are ignored, because it is invisible. `below` (N,): distance of each point below
    a level top. A point nearer to the top than to the side counts only outside the circle.
    """
    edge = np.zeros(len(plan), bool) if below is None else below < 2 * noise_mm
    for step in range(_MAX_ITERATIONS):
        arms = plan - centre
        rho = np.maximum(np.hypot(arms[:, 0], arms[:, 1]), 1e-9)
        error = rho - radius
        weight = _tukey(error / noise_mm) * (edge | (arms @ away < _NEAR_SIDE * radius))
        if below is not None:
            weight = weight * (-error < np.maximum(below, 0.0))
        design = np.column_stack([-arms / rho[:, None], -np.ones(len(plan))])
        normal = design.T @ (design * weight[:, None]) + 1e-9 * np.eye(3)
        move = -np.linalg.solve(normal, design.T @ (weight * error))
        centre, radius = centre + move[:2], radius + float(move[2])
        if not 0 < radius < largest_mm:
            return None
        if np.abs(move).max() < 1e-2 and step > 1:
            break
    return Circle(float(centre[0]), float(centre[1]), radius, weight > 0)


def _tukey(scaled: Array) -> Array:
    """Return the weights of residuals in units of the noise; 4.7 keeps 95 % of the efficiency for Gaussian noise."""
    return np.asarray(np.maximum(1 - (scaled / 4.685) ** 2, 0.0) ** 2)


def _circles_through(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Return centres (K, 2) and radii (K,) of circles through three points each; not finite for collinear points."""
    ab, ac = b - a, c - a
    cross = 2 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    bb, cc = (ab**2).sum(1), (ac**2).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (ac[:, 1] * bb - ab[:, 1] * cc) / cross
        y = (ab[:, 0] * cc - ac[:, 0] * bb) / cross
    return a + np.stack([x, y], axis=1), np.hypot(x, y)


def fit_cuboid(points: Array, height: float, eye: Array) -> Cuboid:
    """Fit a box to the points, its sides to those below the top; eye (2,): the camera's foot on the table.

    Visible faces lie at the median of their points, the others at the end of the points in plan.
    """
    centre = np.median(points[:, :2], axis=0)
    plan = points[:, :2] - centre
    below = points[:, 2] < height - 5.0
    side = plan[below] if below.sum() > 20 else plan
    coarse = _best_yaw(plan, side, np.radians(np.arange(0.0, 90.0, 6.0)))
    yaw = _best_yaw(plan, side, coarse + np.radians(np.arange(-5.0, 5.1, 1.0)))
    local = rotate_plan(plan, yaw)
    low, high = _fit_visible_faces(
        local, height - points[:, 2], *_extent(local), rotate_plan((eye - centre)[None], yaw)[0]
    )
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 0.5)
    x, y = rotate_plan(middle[None], -yaw)[0] + centre
    if half[0] < half[1]:
        half, yaw = half[::-1], yaw + math.pi / 2
    return Cuboid(float(x), float(y), (float(half[0]), float(half[1])), height, yaw % math.pi)


def _fit_visible_faces(local: Array, below: Array, low: Array, high: Array, eye: Array) -> tuple[Array, Array]:
    """Put faces towards the eye at the median of their nearest points, the others at the end of the top."""
    faces = np.concatenate([low, high])
    for _ in range(2):
        gaps = np.abs(np.concatenate([local, local], axis=1) - faces)
        nearest = np.column_stack([gaps, np.abs(below)]).argmin(1)
        top = local[nearest == 4]
        for face, is_visible in enumerate((*(eye < low), *(eye > high))):
            places = local[nearest == face, face % 2]
            if is_visible and len(places) >= 10:
                faces[face] = np.median(places)
            elif not is_visible and len(top) >= 100:
                faces[face] = np.quantile(top[:, face % 2], 0.005 if face < 2 else 0.995)
    return faces[:2], faces[2:]


def _extent(local: Array) -> tuple[Array, Array]:
    """Return minimum and maximum along the axis before the last one, without 1 % of the points on either side."""
    count = local.shape[-2]
    skip = count // 100
    ordered = np.partition(local, [skip, count - 1 - skip], axis=-2)
    return ordered[..., skip, :], ordered[..., -1 - skip, :]


def _best_yaw(plan: Array, side: Array, yaws: Array) -> float:
    """Return the yaw with the smallest mean distance of side points from the box's faces, truncated at 10 mm."""
    c, s = np.cos(yaws), np.sin(yaws)
    turns = np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
    low, high = _extent(_subsample(plan) @ turns)
    local = _subsample(side) @ turns
    gap = np.minimum(np.abs(local - low[:, None]), np.abs(local - high[:, None])).min(-1)
    return float(yaws[np.minimum(gap, 10.0).mean(-1).argmin()])


def _subsample(points: Array) -> Array:
    return points[:: max(1, len(points) // 300)]


def fit_lying_cylinder(points: Array, box: Cuboid, along_length: bool, eye: Array) -> LyingCylinder | None:
    """Fit a cylinder on its side, starting at the box's long or short direction; return None if the steps diverge.

    Gauss-Newton with Tukey's weights on sqrt(v^2 + (z - r)^2) - r, where v is the distance across the axis. Unknowns
    are the axis's yaw and offset, and the radius. The axis lies at the height of the radius.
    """
    yaw = box.yaw_rad if along_length else box.yaw_rad + math.pi / 2
    offset, radius = 0.0, box.height / 2
    origin = np.array([box.x, box.y])
    for _ in range(_MAX_ITERATIONS):
        along, across = rotate_plan(points[:, :2] - origin, yaw).T
        arms = np.stack([across - offset, points[:, 2] - radius], axis=1)
        rho = np.maximum(np.hypot(arms[:, 0], arms[:, 1]), 1e-9)
        error = rho - radius
        weight = _tukey(error / max(2.0, 1.4826 * float(np.median(np.abs(error)))))
        design = np.column_stack([-along * arms[:, 0] / rho, -arms[:, 0] / rho, -arms[:, 1] / rho - 1.0])
        normal = design.T @ (design * weight[:, None]) + 1e-6 * np.eye(3)
        move = -np.linalg.solve(normal, design.T @ (weight * error))
        yaw, offset, radius = yaw + float(move[0]), offset + float(move[1]), radius + float(move[2])
        if not 1.0 < radius < box.height or abs(move[0]) > 0.5:
            return None
    low, high = _ends(points, origin, yaw, offset, radius, eye)
    x, y = origin + rotate_plan(np.array([[(low + high) / 2, offset]]), -yaw)[0]
    return LyingCylinder(float(x), float(y), ((high - low) / 2, radius), 2 * radius, yaw % math.pi)


def _ends(points: Array, origin: Array, yaw: float, offset: float, radius: float, eye: Array) -> tuple[float, float]:
    """Return the ends of the axis: the visible flat end, else the end of the points."""
    along, across = rotate_plan(points[:, :2] - origin, yaw).T
    low, high = (float(edge[0]) for edge in _extent(along[:, None]))
    towards = float(rotate_plan((eye - origin)[None], yaw)[0, 0])
    inner = np.hypot(across - offset, points[:, 2] - radius) < 0.7 * radius
    flat = along[inner & (np.abs(along - (low if towards < 0 else high)) < 0.5 * radius)]
    if len(flat) >= 10 and not low < towards < high:
        return (float(np.median(flat)), high) if towards < 0 else (low, float(np.median(flat)))
    return low, high
