"""One-sided depth pictures of simple solids on a table, from a Kinect 2 in front of and above it.

Rays are intersected in closed form. Noise is white along the optical axis; outliers are up to 200 mm in front of or
behind the surface, everywhere in the picture.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from robot.readings import RGBD, Intrinsics

KINECT = Intrinsics(365.0, 365.0, 255.5, 211.5)
KINECT_PX = (424, 512)
TABLE_COLOUR, OBJECT_COLOUR = (150, 140, 120), (60, 110, 200)


@dataclass(frozen=True)
class UprightCylinder:
    """A standing cylinder."""

    radius: float
    height: float
    x: float = 0.0
    y: float = 0.0

    def hit(self, origin, rays):
        offset = origin - [self.x, self.y, 0.0]
        side = _quadratic(rays, offset, (0, 1), self.radius)
        z = offset[2] + side * rays[:, 2]
        side[(z < 0) | (z > self.height)] = np.inf
        return np.minimum(side, self._top(offset, rays))

    def _top(self, offset, rays):
        top = (self.height - offset[2]) / rays[:, 2]
        x, y = offset[0] + top * rays[:, 0], offset[1] + top * rays[:, 1]
        return np.where((top > 0) & (np.hypot(x, y) <= self.radius), top, np.inf)


@dataclass(frozen=True)
class LyingCylinder:
    """A cylinder on its side, its axis turned by `yaw` from x."""

    radius: float
    length: float
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def hit(self, origin, rays):
        turn = _turn(self.yaw)
        offset, local = turn @ (origin - [self.x, self.y, self.radius]), rays @ turn.T
        side = _quadratic(local, offset, (1, 2), self.radius)
        along = offset[0] + side * local[:, 0]
        hits = [np.where(np.abs(along) <= self.length / 2, side, np.inf)]
        for end in (-self.length / 2, self.length / 2):
            with np.errstate(divide="ignore", invalid="ignore"):
                flat = (end - offset[0]) / local[:, 0]
                across = np.hypot(offset[1] + flat * local[:, 1], offset[2] + flat * local[:, 2])
            hits.append(np.where((flat > 0) & (across <= self.radius), flat, np.inf))
        return np.minimum.reduce(hits)


@dataclass(frozen=True)
class DepthBlock:
    """A box, its first side turned by `yaw` from x."""

    length: float
    width: float
    height: float
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def hit(self, origin, rays):
        turn = _turn(self.yaw)
        offset, local = turn @ (origin - [self.x, self.y, self.height / 2]), rays @ turn.T
        half = np.array([self.length, self.width, self.height]) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (-half - offset) / local, (half - offset) / local
        enter, leave = np.minimum(first, second).max(1), np.maximum(first, second).min(1)
        return np.where((enter <= leave) & (enter > 0), enter, np.inf)


@dataclass(frozen=True)
class DepthBall:
    """A sphere that lies on the table."""

    radius: float
    x: float = 0.0
    y: float = 0.0

    def hit(self, origin, rays):
        return _quadratic(rays, origin - [self.x, self.y, self.radius], (0, 1, 2), self.radius)


def _turn(yaw):
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _quadratic(rays, offset, axes, radius):
    """Return the first distance t at which the components `axes` of offset + t ray have norm `radius`."""
    rays, offset = rays[:, axes], offset[list(axes)]
    a, b, c = (rays**2).sum(1), rays @ offset, offset @ offset - radius**2
    root = b * b - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        near = (-b - np.sqrt(root)) / a
    return np.where((root >= 0) & (near > 0), near, np.inf)


def camera_pose(distance_mm=900.0, down_deg=35.0, target=(0.0, 0.0, 50.0)):
    """Return the (4, 4) transform from camera frame to rig frame; the camera is at -y and points down to the target."""
    down = math.radians(down_deg)
    forward = np.array([0.0, math.cos(down), -math.sin(down)])
    right = np.array([1.0, 0.0, 0.0])
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(forward, right), forward, target - distance_mm * forward], axis=1)
    return matrix


@lru_cache(maxsize=4)
def _rays(lens, px, rotation):
    """Return (H * W, 3) directions with depth 1, in the rig's frame."""
    v, u = np.mgrid[: px[0], : px[1]].reshape(2, -1)
    local = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(u.size)], 1)
    return local @ np.frombuffer(rotation).reshape(3, 3).T


def view(*solids, noise_mm=1.5, outliers=0.0, seed=0, pose=None, missing=(), lens=KINECT, px=KINECT_PX):
    """Return an RGBD picture of solids on the table; `missing` solids have no depth, like glass."""
    rng, matrix = np.random.default_rng([5, seed]), camera_pose() if pose is None else pose
    rows, columns = px
    rays, origin = _rays(lens, px, matrix[:3, :3].tobytes()), matrix[:3, 3]
    with np.errstate(divide="ignore"):
        table = np.where(rays[:, 2] < 0, -origin[2] / rays[:, 2], np.inf)
    hits = np.stack([table, *(solid.hit(origin, rays) for solid in (*solids, *missing))])
    depth = hits.min(0)
    depth[hits.argmin(0) > len(solids)] = np.nan
    depth += rng.normal(0.0, noise_mm, depth.shape)
    is_outlier = rng.uniform(size=depth.shape) < outliers
    depth[is_outlier] += rng.uniform(-200.0, 200.0, int(is_outlier.sum()))
    depth[~np.isfinite(depth) | (depth < 50)] = np.nan
    colour = np.where(hits.argmin(0)[:, None] > 0, OBJECT_COLOUR, TABLE_COLOUR) + rng.normal(0, 2, (len(rays), 3))
    return RGBD(
        np.clip(colour + 0.5, 0, 255).astype(np.uint8).reshape(rows, columns, 3),
        (depth / 1000).astype(np.float32).reshape(rows, columns),
        lens,
        0.0,
    )
