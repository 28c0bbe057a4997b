"""Points of the object on the table from a depth picture: fit the table's plane, then segment the points above it."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from robot.errors import PlanError
from robot.readings import RGBD, Region

Array = npt.NDArray[np.float64]
Depth = npt.NDArray[np.float32]

_MAX_HEIGHT_MM = 400.0
_NEAR_TABLE_MM = 40.0
_TABLE_TOLERANCE_MM = 6.0
_MAX_SLOPE = 0.1
_SAMPLES, _HYPOTHESES = 3000, 64
_MIN_HEIGHT_MM, _MIN_PX, _MAX_POINTS = 5.0, 30, 900


@dataclass(frozen=True)
class TablePlane:
    """The table's plane z = a x + b y + c (mm) in the rig's frame, and the depth noise along a ray (mm)."""

    a: float
    b: float
    c: float
    noise_mm: float


@dataclass(frozen=True)
class Rays:
    """Rays of all pixels: a pixel's point is the camera's position + depth_mm * direction.

    x (W,) and y (H,) are those of a column's and a row's ray in the camera's frame, at depth 1; pose (4, 4), in mm, is
    from the camera's frame to the rig's.
    """

    x: npt.NDArray[np.float32]
    y: npt.NDArray[np.float32]
    pose: Array

    @classmethod
    def from_image(cls, image: RGBD, extrinsics: Array) -> "Rays":
        """Return the rays of the pixels of `image`; `extrinsics` (4, 4): camera frame to rig frame, mm."""
        lens, (rows, columns) = image.intrinsics, image.colour.shape[:2]
        assert lens is not None, "a picture with depth has intrinsics"
        x = (np.arange(columns, dtype=np.float32) - lens.cx) / lens.fx
        y = (np.arange(rows, dtype=np.float32) - lens.cy) / lens.fy
        return cls(x.astype(np.float32), y.astype(np.float32), extrinsics)

    @property
    def steepness(self) -> float:
        """Slope of the middle ray at depth 1: the factor from depth noise to height noise."""
        return abs(float(self.pose[2, 2]))

    def along(self, normal: Array) -> Depth:
        """Return the (H, W) component of each ray along a vector (3,) of the rig's frame, at depth 1."""
        local = (self.pose[:3, :3].T @ normal).astype(np.float32)
        return np.asarray(self.x[None, :] * local[0] + (self.y[:, None] * local[1] + local[2]))

    def points(self, depth_mm: Depth, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp]) -> Array:
        """Return the (N, 3) points of N pixels in the rig's frame, mm."""
        depth = depth_mm[rows, columns].astype(np.float64)
        local = np.stack([self.x[columns] * depth, self.y[rows] * depth, depth], axis=1)
        return np.asarray(local @ self.pose[:3, :3].T + self.pose[:3, 3])


def find_table(depth_mm: Depth, rays: Rays) -> TablePlane:
    """Fit the table near z = 0, its height by the calibration: RANSAC over three points, then least squares.

    If too little of the table is visible, the result is z = 0. `depth_mm` (H, W) is NaN where unknown.
    """
    step = max(1, int(np.sqrt(depth_mm.size / _SAMPLES)))
    rows, columns = np.nonzero(np.isfinite(depth_mm[::step, ::step]))
    points = rays.points(depth_mm, rows * step, columns * step)
    near = points[np.abs(points[:, 2]) < _NEAR_TABLE_MM]
    if len(near) < 100:
        return TablePlane(0.0, 0.0, 0.0, 2.0)
    plane = _best_plane(near)
    for _ in range(3):
        off = near[:, 2] - _heights(plane, near)
        inside = near[np.abs(off) < _TABLE_TOLERANCE_MM]
        design = np.column_stack([inside[:, :2], np.ones(len(inside))])
        plane = np.asarray(np.linalg.lstsq(design, inside[:, 2], rcond=None)[0], np.float64)
    off = near[:, 2] - _heights(plane, near)
    noise = 1.4826 * float(np.median(np.abs(off))) / max(rays.steepness, 0.1)
    a, b, c = map(float, plane)
    return TablePlane(a, b, c, max(noise, 0.3))


def _best_plane(points: Array) -> Array:
    """Return (3,) a, b, c of the plane through three points, of limited slope, with the most inliers."""
    rng = np.random.default_rng(0)
    some = points[rng.choice(len(points), min(len(points), 400), replace=False)]
    triples = some[rng.integers(len(some), size=(_HYPOTHESES, 3))]
    system = np.concatenate([triples[..., :2], np.ones((_HYPOTHESES, 3, 1))], axis=2)
    good = np.abs(np.linalg.det(system)) > 100.0  # mm2: excludes three points almost on a line
    planes = np.linalg.solve(system[good], triples[good][..., 2:])[..., 0]
    planes = planes[(np.hypot(planes[:, 0], planes[:, 1]) < _MAX_SLOPE)]
    planes = np.concatenate([planes, [[0.0, 0.0, float(np.median(points[:, 2]))]]])
    off = some[None, :, 2] - _heights(planes.T[..., None], some)
    return np.asarray(planes[(np.abs(off) < _TABLE_TOLERANCE_MM).sum(1).argmax()])


def _heights(plane: Array, points: Array) -> Array:
    return np.asarray(plane[0] * points[:, 0] + plane[1] * points[:, 1] + plane[2])


def find_object_points(
    depth_mm: Depth, rays: Rays, table: TablePlane, region: Region | None = None
) -> tuple[Array, bool]:
    """Find the largest connected object above the table; the x and y of `region` limit the search.

    Returns:
        Its points (N, 3) in mm, z above the table, and whether it touches the picture's border.

    Raises:
        PlanError: There is no object.
    """
    normal = np.array([-table.a, -table.b, 1.0])
    camera_mm = np.float32(float(normal @ rays.pose[:3, 3]) - table.c)
    above = np.asarray(depth_mm * rays.along(normal) + camera_mm)  # the height of each pixel
    min_height_mm = max(_MIN_HEIGHT_MM, 3.0 * table.noise_mm * rays.steepness)
    raised = (above > min_height_mm) & (above < _MAX_HEIGHT_MM)
    if region is not None:
        for axis in (0, 1):
            position = depth_mm * rays.along(np.eye(3)[axis]) + np.float32(rays.pose[axis, 3])
            raised &= (position >= region.lower[axis]) & (position <= region.upper[axis])
    candidates = cv2.medianBlur(raised.astype(np.uint8), 5)  # without single pixels
    _, labels, stats, _ = cv2.connectedComponentsWithStats(candidates, connectivity=8)
    sizes = stats[1:, cv2.CC_STAT_AREA]
    if sizes.max(initial=0) < _MIN_PX:
        raise PlanError("no object in the depth picture: it is missing, transparent or outside the picture")
    best = 1 + int(sizes.argmax())
    left, top, width, height = (int(value) for value in stats[best, :4])
    last_row, last_column = (size - 1 for size in raised.shape)
    is_cut_off = left <= 1 or top <= 1 or left + width >= last_column or top + height >= last_row
    rows, columns = ((labels == best) & raised).nonzero()
    points = rays.points(depth_mm, rows, columns)
    points[:, 2] = above[rows, columns]
    level = rays.steepness / (float(np.median(depth_mm[rows, columns])) * float(rays.x[1] - rays.x[0])) ** 2
    points = _remove_outliers(points, level)
    if len(points) > _MAX_POINTS:
        points = points[np.sort(np.random.default_rng(0).choice(len(points), _MAX_POINTS, replace=False))]
    return points, is_cut_off


def _remove_outliers(points: Array, level: float, cell_mm: float = 6.0) -> Array:
    """Drop points with few neighbours in plan compared with a level surface, which has `level` points on each mm2.

    Outliers lie along their rays, far from the object's footprint and from each other.
    """
    cells = np.floor((points[:, :2] - points[:, :2].min(0)) / cell_mm).astype(np.intp) + 1
    rows, columns = cells.max(0) + 2
    grid = np.bincount(cells[:, 0] * columns + cells[:, 1], minlength=rows * columns).reshape(rows, columns)
    around = cv2.boxFilter(grid.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    dense = around[cells[:, 0], cells[:, 1]] >= max(3.0, 0.3 * level * 9 * cell_mm**2)
    return points[dense] if dense.any() else points
