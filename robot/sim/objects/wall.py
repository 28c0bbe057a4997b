"""Relief on the unrolled wall of an object, baked into height maps from fine to coarse.

A height map is computed once per object and interpolated bilinearly. Where the shape turns away from its chart (rims,
caps, poles, the far side of a handle), relief fades out, so that it never tears at an edge.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from robot.sim.objects.packets import ReliefLevel
from robot.sim.objects.relief import Relief, Sheet
from robot.sim.objects.shapes.shape import Chart, Floats, Points, Shape

_LEVELS = 4
_CELL_MM = 1.5


def level_of(levels: Sequence[ReliefLevel], step_mm: float) -> ReliefLevel:
    """Return the coarsest level whose pixels are at most `step_mm` wide, or the finest level."""
    fitting = [level for level in levels if level.pixel_mm <= step_mm]
    return fitting[-1] if fitting else levels[0]


def bake(shape: Shape, relief: Relief) -> list[ReliefLevel]:
    """Draw relief and the shape's own pattern on its wall; return height maps from fine to coarse, none if smooth."""
    sheet = _sheet(shape.chart)
    height, wall_pattern = relief.height(sheet), shape.wall_pattern(sheet.s, sheet.t)
    if height is None and wall_pattern is None:
        return []
    weight, stretch = _relief_weights(shape, sheet, relief.amplitude_mm)
    total = np.asarray(sum(part for part in (height, wall_pattern) if part is not None) * weight, np.float32)
    return _levels(total, sheet, stretch, shape.mask_slope)


def bake_plain(chart: Chart, relief: Relief) -> list[ReliefLevel]:
    """Draw only the relief, everywhere; return height maps from fine to coarse, none if smooth."""
    sheet = _sheet(chart)
    height = relief.height(sheet)
    return [] if height is None else _levels(height, sheet, np.ones(2, np.float32), 0.0)


def _sheet(chart: Chart) -> Sheet:
    """Return nodes for a wall; columns and rows can be halved `_LEVELS` times."""
    width, height = chart.width_mm, chart.height_mm
    pixel = max(0.14, np.sqrt(width * height / 1.2e6))  # in mm; at most 1.2 million nodes
    block = 2 ** (_LEVELS - 1)
    return Sheet(
        width, height, block * int(np.ceil(height / pixel / block)) + 1, block * int(np.ceil(width / pixel / block))
    )


def _levels(height: Floats, sheet: Sheet, stretch: Floats, mask_slope: float) -> list[ReliefLevel]:
    levels = []
    for number in range(_LEVELS):
        if number:
            height = np.ascontiguousarray(_downsample(height))
        rows, columns = height.shape
        per_s, per_t = columns / sheet.width_mm, (rows - 1) / sheet.height_mm
        padded = np.concatenate([height, height[:, :2]], axis=1)
        slope = _max_slope(padded, per_s, per_t, stretch) + mask_slope * float(np.abs(height).max())
        levels.append(ReliefLevel(padded, per_s, per_t, float(height.max()), slope, max(1 / per_s, 1 / per_t)))
    return levels


def _downsample(height: Floats) -> Floats:
    """Return every other node after a binomial blur; the blur is periodic along s and clamped at the ends of t."""
    wide = cv2.copyMakeBorder(height, 0, 0, 2, 2, cv2.BORDER_WRAP)
    kernel = np.array([1, 4, 6, 4, 1], np.float32) / 16
    return np.asarray(cv2.sepFilter2D(wide, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)[::2, 2:-2:2])


def _max_slope(padded: Floats, per_s: float, per_t: float, stretch: Floats) -> float:
    """Return the largest slope of the bilinear surface, measured on the object and not on the map."""
    across = cv2.absdiff(padded[:, 1:], padded[:, :-1]).max(axis=1) * per_s
    rows = np.linspace(0, len(stretch) - 1, len(across)).round().astype(int)
    along = cv2.absdiff(padded[1:], padded[:-1]).max() * per_t
    return float(np.hypot((across * stretch[rows]).max(), along))


# Weight of relief --------------------------------------------------------------------------------------------


def _relief_weights(shape: Shape, sheet: Sheet, amplitude_mm: float) -> tuple[Floats, Floats]:
    """Return the weight of relief at each node (rows, columns), and the stretch of the map, by coarse row.

    The wall is sampled from outside, along the chart's rays, on a coarse grid.
    """
    rows = max(int(sheet.height_mm / _CELL_MM), 12) + 1
    columns = max(int(sheet.width_mm / _CELL_MM), 24)
    coarse = Sheet(sheet.width_mm, sheet.height_mm, rows, columns)
    s, t = np.meshgrid(coarse.s, coarse.t)
    points, hit, facing, gain = _cast_chart_rays(shape, s.ravel(), t.ravel())
    place = np.where(hit[:, None], points, np.nan).reshape(rows, columns, 3)
    step = np.linalg.norm(np.roll(place, -1, axis=1) - np.roll(place, 1, axis=1), axis=2) / (2 * coarse.pixel_mm[1])
    room = np.nan_to_num(step, nan=0.0).clip(0.05, 1)
    weight = (smoothstep(facing, 0.35, 0.8) * gain).reshape(rows, columns) * np.clip(2.2 * room - 0.2, 0, 1)
    weight *= ends_weight(coarse.t, coarse.height_mm, max(1.5, 0.8 * amplitude_mm))[:, None]
    used = np.where(weight > 0.02, room, 1).min(axis=1)
    return _upsample_weights(weight.astype(np.float32), sheet, amplitude_mm), np.asarray(1 / used, np.float32)


def _cast_chart_rays(shape: Shape, s: Floats, t: Floats) -> tuple[Points, NDArray[np.bool_], Points, Points]:
    """Return points, hits, cosine to the ray and slope of the distance where the chart's rays meet the wall."""
    origins, directions = shape.chart.rays(s, t)
    p, d = origins.astype(np.float32), directions.astype(np.float32)
    far, travelled = np.float32(np.linalg.norm(shape.upper - shape.lower) + 4), np.zeros(len(p), np.float32)
    for _ in range(48):
        step = shape.distance(p)
        travelled += step
        p = p + step[:, None] * d
        if not ((step > 0.02) & (travelled < far)).any():
            break
    hit = (np.abs(shape.distance(p)) < 0.1) & (travelled < far)
    sides = 0.3 * np.eye(3, dtype=np.float32)
    gradient = np.stack([shape.distance(p + side) - shape.distance(p - side) for side in sides], axis=1) / 0.6
    gain = np.linalg.norm(gradient, axis=1)
    facing = -np.sum(gradient * d, axis=1) / np.maximum(gain, 1e-6)
    return p, hit, np.where(hit, facing, 0), np.clip(gain, 0, 1)


def smoothstep(x: Points, low: float, high: float) -> Points:
    """Return 0 below `low`, 1 above `high`, smooth between."""
    u = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(u * u * (3 - 2 * u))


def ends_weight(t: Points, height_mm: float, fade_mm: float) -> Points:
    """Return 0 at the lowest and highest place, so that the foot stays on the table; 1 further in."""
    return smoothstep(np.minimum(t, height_mm - t), 0.3, 0.3 + fade_mm)


def _upsample_weights(weight: Floats, sheet: Sheet, amplitude_mm: float) -> Floats:
    """Interpolate the weights at the fine nodes, shrunk from their edges and smoothed."""
    wide = cv2.copyMakeBorder(weight, 0, 0, 4, 4, cv2.BORDER_WRAP)
    shrunk = cv2.erode(wide, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    shrunk = cv2.GaussianBlur(shrunk, (0, 0), sigmaX=max(0.7, 0.4 * amplitude_mm / _CELL_MM))
    fine = sheet.resample(shrunk, 4, cv2.INTER_LINEAR)
    return np.asarray(fine * ends_weight(sheet.t, sheet.height_mm, 1.0)[:, None], np.float32)
