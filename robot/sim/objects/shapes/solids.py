"""Other solids: ellipsoids, superquadrics, blobs, rings, mugs, combs, brushes."""

from dataclasses import dataclass

import numpy as np

from robot.sim.objects.shapes.revolution import Drum, Revolution
from robot.sim.objects.shapes.shape import (
    Chart,
    CylindricalChart,
    Floats,
    Points,
    Shape,
    bounds,
    length,
    relief_limit,
    rounded_corner,
    smooth_min,
)


class TwoSidedChart(Chart):
    """Front and back of a flat object: s = x across the front, then back across the back; t = z."""

    def __init__(self, half_x_mm: float, height_mm: float, reach_mm: float) -> None:
        self.half_x_mm, self.width_mm, self.height_mm = half_x_mm, 4 * half_x_mm, height_mm
        self._reach_mm = reach_mm + 1

    def locate(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Return map coordinates of points on or near the wall."""
        half = np.float32(self.half_x_mm)
        across = np.clip(x, -half, half) + half
        return np.where(y < 0, across, 4 * half - across), z

    def rays(self, s: Floats, t: Floats) -> tuple[Points, Points]:
        """Return rays towards front or back, at map coordinates (s, t)."""
        front = s < 2 * self.half_x_mm
        x = np.where(front, s, 4 * self.half_x_mm - s) - self.half_x_mm
        side = np.where(front, -1.0, 1.0)
        zero = np.zeros_like(side)
        return np.stack([x, side * self._reach_mm, t], axis=1), np.stack([zero, -side, zero], axis=1)


class Superquadric(Shape):
    """((|x/a|^e + |y/b|^e)^(f/e) + |z/c|^f)^(1/f) = 1 with e, f >= 2, cut flat at the foot; e = f = 2: an ellipsoid.

    The left side is a norm, so min(a, b, c) times its excess over 1 never exceeds the distance.
    """

    def __init__(
        self, half_mm: tuple[float, float, float], *, round_power: float = 2, upright_power: float = 2
    ) -> None:
        self.half_mm, self.round_power, self.upright_power = half_mm, round_power, upright_power
        self.middle_mm = 0.93 * half_mm[2]
        self.lower, self.upper = bounds(half_mm[0], half_mm[1], half_mm[2] + self.middle_mm)
        self.chart = CylindricalChart(float(np.sqrt(half_mm[0] * half_mm[1])), self.upper[2], max(half_mm) + 1)
        self.relief_limit_mm = relief_limit(2 * min(half_mm[:2]))

    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return a lower bound on the signed distance."""
        a, b, c = (np.float32(1 / half) for half in self.half_mm)
        e, f = self.round_power, self.upright_power
        norm = _norm(_norm(x * a, y * b, e), (z - np.float32(self.middle_mm)) * c, f)
        distance: Floats = np.maximum((norm - 1) * np.float32(min(self.half_mm)), -z)
        return distance


def _norm(a: Floats, b: Floats, power: float) -> Floats:
    """Return (|a|^power + |b|^power)^(1/power), scaled by the larger term so that no power overflows."""
    if power == 2:
        return length(a, b)
    a, b = np.abs(a), np.abs(b)
    large = np.maximum(np.maximum(a, b), np.float32(1e-9))
    ratio = np.maximum(np.minimum(a, b) / large, np.float32(1e-9))
    # numpy vectorises exp and log of float32 but not power; this takes a tenth of the time.
    return large * np.exp(np.log1p(np.exp(np.log(ratio) * np.float32(power))) * np.float32(1 / power))


class Blobs(Shape):
    """Blended balls, each (x, y, z, radius) in mm, with seams of `blend_mm`, cut flat at z = 0."""

    def __init__(self, balls: tuple[tuple[float, float, float, float], ...], *, blend_mm: float) -> None:
        self.balls, self.blend_mm = balls, blend_mm
        array = np.array(balls)
        bulge = blend_mm / 4
        high = (array[:, :3] + array[:, 3:]).max(axis=0) + bulge
        low = (array[:, :3] - array[:, 3:]).min(axis=0) - bulge
        self.lower, self.upper = np.array([*low[:2], 0.0]), high
        reach = float(np.hypot(*np.maximum(np.abs(low), np.abs(high))[:2]))
        self.chart = CylindricalChart(float(np.mean(high[:2] - low[:2])) / 2, float(high[2]), reach + 1)
        self.relief_limit_mm = relief_limit(float((high - low)[:2].min()), 2.0)

    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return a lower bound on the signed distance."""
        distance = None
        for bx, by, bz, radius in self.balls:
            p, q, r = x - np.float32(bx), y - np.float32(by), z - np.float32(bz)
            ball = np.sqrt(p * p + q * q + r * r) - np.float32(radius)
            distance = ball if distance is None else smooth_min(distance, ball, self.blend_mm)
        assert distance is not None
        cut: Floats = np.maximum(distance, -z)
        return cut


class Ring(Shape):
    """A torus on a flat foot, with its hole to the front, optionally stretched upwards.

    `ring_mm` is the radius of the tube's centre line, `tube_mm` that of the tube; straight parts are `stretch_mm` long.
    """

    def __init__(self, ring_mm: float, tube_mm: float, *, stretch_mm: float = 0.0) -> None:
        self.ring_mm, self.tube_mm, self.stretch_mm = ring_mm, tube_mm, stretch_mm
        self.middle_mm = ring_mm + 0.85 * tube_mm + stretch_mm / 2
        top = self.middle_mm + ring_mm + tube_mm + stretch_mm / 2
        self.lower, self.upper = bounds(ring_mm + tube_mm, tube_mm, top)
        self.chart = TwoSidedChart(ring_mm + tube_mm, top, tube_mm)
        self.relief_limit_mm = relief_limit(2 * tube_mm)

    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return the signed distance."""
        half = np.float32(self.stretch_mm / 2)
        rise = z - np.float32(self.middle_mm)
        rise = rise - np.clip(rise, -half, half)
        tube = length(length(x, rise) - np.float32(self.ring_mm), y) - np.float32(self.tube_mm)
        distance: Floats = np.maximum(tube, -z)
        return distance


class Mug(Revolution):
    """A cup, open at the top, with a handle on its right: radius of its centre line and its thickness are `ear_mm`."""

    def __init__(self, outside: Drum, inside: Drum, ear_mm: tuple[float, float]) -> None:
        super().__init__((outside,), outside.top_mm, hollow=inside)
        self.ear_mm = ear_mm
        self.upper = self.upper + np.array([sum(ear_mm), 0, 0])
        self.chart = CylindricalChart(outside.radius_mm, outside.top_mm, self.upper[0] + 1)

    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return a lower bound on the signed distance."""
        assert self.hollow is not None
        cup = self.parts[0].distance(length(x, y), z)
        ring, tube = (np.float32(value) for value in self.ear_mm)
        around = length(x - np.float32(self.radius_mm), z - np.float32(self.height_mm / 2))
        union = smooth_min(cup, length(around - ring, y) - tube, 2.0)
        return np.maximum(np.maximum(union, -self.hollow.distance(length(x, y), z)), -z)


@dataclass(frozen=True)
class Brick:
    """An upright box: middle (x, y), half sizes (x, y), from `bottom_mm` to `top_mm`, with rounded edges."""

    middle_mm: tuple[float, float]
    half_mm: tuple[float, float]
    bottom_mm: float
    top_mm: float
    rim_mm: float

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return the signed distance in mm, exact outside."""
        p = np.abs(x - np.float32(self.middle_mm[0])) - np.float32(self.half_mm[0])
        q = np.abs(y - np.float32(self.middle_mm[1])) - np.float32(self.half_mm[1])
        rise = np.abs(z - np.float32((self.top_mm + self.bottom_mm) / 2))
        return rounded_corner(
            rounded_corner(p, q, self.rim_mm), rise - np.float32((self.top_mm - self.bottom_mm) / 2), self.rim_mm
        )


class Bricks(Shape):
    """Union of upright boxes: brackets, steps, crosses."""

    def __init__(self, bars: tuple[Brick, ...]) -> None:
        self.bars = bars
        middle, half = np.array([bar.middle_mm for bar in bars]), np.array([bar.half_mm for bar in bars])
        low, high = (middle - half).min(axis=0), (middle + half).max(axis=0)
        top = max(bar.top_mm for bar in bars)
        self.lower, self.upper = np.array([*low, 0.0]), np.array([*high, top])
        half_x, half_y = np.maximum(np.abs(low), np.abs(high))
        self.chart = TwoSidedChart(float(half_x), top, float(half_y))
        self.relief_limit_mm = relief_limit(float((high - low).min()), 3 * float(half.min()) / 4)

    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return the signed distance to the nearest box."""
        distance = self.bars[0].distance(x, y, z)
        for bar in self.bars[1:]:
            distance = np.minimum(distance, bar.distance(x, y, z))
        return distance


class Comb(Shape):
    """A slab with slots `gap_mm` wide every `pitch_mm`, from `slot_mm` above (to the right of) its middle.

    The slots are open at the top or, if it is lying, at the right.
    """

    def __init__(self, slab: Brick, *, pitch_mm: float, gap_mm: float, slot_mm: float, lying: bool) -> None:
        self.slab, self.pitch_mm, self.gap_mm, self.slot_mm, self.lying = slab, pitch_mm, gap_mm, slot_mm, lying
        self.lower, self.upper = bounds(*slab.half_mm, slab.top_mm)
        self.chart = TwoSidedChart(slab.half_mm[0], slab.top_mm, slab.half_mm[1])
        self.relief_limit_mm = min(relief_limit(2 * slab.half_mm[1]), (pitch_mm - gap_mm) / 8)

    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return a lower bound on the signed distance."""
        half = self.slab.top_mm / 2
        along, across = (z - np.float32(half), x) if self.lying else (x, z - np.float32(half))
        room = (half if self.lying else self.slab.half_mm[0]) - self.pitch_mm
        cells = np.float32(max(int(room / self.pitch_mm), 0))
        along = along - np.float32(self.pitch_mm) * np.clip(np.rint(along / np.float32(self.pitch_mm)), -cells, cells)
        slot = np.maximum(np.abs(along) - np.float32(self.gap_mm / 2), np.float32(self.slot_mm) - across)
        distance: Floats = np.maximum(self.slab.distance(x, y, z), -slot)
        return distance


class Brush(Shape):
    """A block with upright bristles of radius `bristle_mm` every `pitch_mm`, whose tops are at `top_mm`."""

    def __init__(self, block: Brick, *, bristle_mm: float, pitch_mm: float, top_mm: float) -> None:
        self.block, self.bristle_mm, self.pitch_mm, self.top_mm = block, bristle_mm, pitch_mm, top_mm
        self.lower, self.upper = bounds(*block.half_mm, top_mm)
        self.chart = TwoSidedChart(block.half_mm[0], top_mm, block.half_mm[1])
        self.relief_limit_mm = min(relief_limit(2 * block.half_mm[1]), bristle_mm / 4)

    def _fold(self, x: Floats, half: float) -> Floats:
        """Return the distance from the nearest row of bristles, along one axis."""
        pitch = np.float32(self.pitch_mm)
        rows = max((half - self.bristle_mm) / self.pitch_mm, 0)
        if int(2 * rows) % 2:  # an even number of rows has none in the middle
            x = np.abs(x) - pitch / 2
            row: Floats = np.clip(np.rint(x / pitch), 0, np.float32(int(rows - 0.5)))
        else:
            row = np.clip(np.rint(x / pitch), -np.float32(int(rows)), np.float32(int(rows)))
        return x - pitch * row

    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return a lower bound on the signed distance."""
        across = length(self._fold(x, self.block.half_mm[0]), self._fold(y, self.block.half_mm[1]))
        middle = np.float32((self.top_mm + self.block.top_mm) / 2)
        rise = np.abs(z - middle) - np.float32((self.top_mm - self.block.top_mm) / 2 + self.block.rim_mm)
        rise = np.maximum(rise, z - np.float32(self.top_mm))
        bristles = rounded_corner(across - np.float32(self.bristle_mm), rise, 0.5 * self.bristle_mm)
        return np.minimum(self.block.distance(x, y, z), bristles)
