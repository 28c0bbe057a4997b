"""Solids of revolution: parts drawn in the half-plane (r, z), joined with rounded seams."""

from dataclasses import dataclass

import numpy as np

from robot.sim.objects.shapes.shape import (
    CylindricalChart,
    Floats,
    Shape,
    bounds,
    length,
    relief_limit,
    rounded_corner,
    smooth_min,
)


@dataclass(frozen=True)
class Drum:
    """A cylinder from `bottom_mm` to `top_mm` with edges rounded by `rim_mm`."""

    radius_mm: float
    bottom_mm: float
    top_mm: float
    rim_mm: float = 0.0

    def distance(self, r: Floats, z: Floats) -> Floats:
        """Return the signed distance in mm."""
        middle, half = (self.top_mm + self.bottom_mm) / 2, (self.top_mm - self.bottom_mm) / 2
        ends = np.abs(z - np.float32(middle)) - np.float32(half)
        return rounded_corner(r - np.float32(self.radius_mm), ends, self.rim_mm)


class Ball:
    """A sphere centred on the axis; with `ring_mm`, a horizontal torus of that radius."""

    def __init__(self, size_mm: float, height_mm: float, *, ring_mm: float = 0.0) -> None:
        self.size_mm, self.height_mm, self.ring_mm = size_mm, height_mm, ring_mm
        self.top_mm, self.radius_mm = height_mm + size_mm, ring_mm + size_mm

    def distance(self, r: Floats, z: Floats) -> Floats:
        """Return the signed distance in mm."""
        return length(r - np.float32(self.ring_mm), z - np.float32(self.height_mm)) - np.float32(self.size_mm)


class Cone:
    """A frustum: radius `base_mm` at the bottom, `head_mm` at the top; `rim_mm` rounds its edges."""

    def __init__(self, base_mm: float, head_mm: float, bottom_mm: float, top_mm: float, *, rim_mm: float = 0.0) -> None:
        self.base_mm, self.head_mm, self.bottom_mm, self.top_mm = base_mm, head_mm, bottom_mm, top_mm
        self.rim_mm, self.radius_mm = rim_mm, max(base_mm, head_mm)

    def distance(self, r: Floats, z: Floats) -> Floats:
        """Return a lower bound on the signed distance."""
        half = np.float32((self.top_mm - self.bottom_mm) / 2)
        height = z - np.float32((self.top_mm + self.bottom_mm) / 2)
        slope = (self.base_mm - self.head_mm) / (self.top_mm - self.bottom_mm)
        cosine = np.float32(1 / np.sqrt(1 + slope**2))
        side = (r - np.float32((self.base_mm + self.head_mm) / 2) + height * np.float32(slope)) * cosine
        # Side and ends do not meet at right angles, but the rounded maximum stays below the distance.
        return -smooth_min(-side, half - np.abs(height), 2 * self.rim_mm)


Profile = Drum | Ball | Cone
"""A flat signed distance in the half-plane r >= 0, with its highest point and greatest distance from the axis."""


class Revolution(Shape):
    """Union of `parts`, minus the part `hollow`; cut flat at z = 0 and at `height_mm`; seams are `blend_mm` wide."""

    def __init__(
        self, parts: tuple[Profile, ...], height_mm: float, *, blend_mm: float = 0.0, hollow: Profile | None = None
    ) -> None:
        self.parts, self.height_mm, self.blend_mm, self.hollow = parts, height_mm, blend_mm, hollow
        # A blend may bulge by a quarter of its width.
        self.radius_mm = max(part.radius_mm for part in parts) + blend_mm / 4 * (len(parts) > 1)
        self.lower, self.upper = bounds(self.radius_mm, self.radius_mm, height_mm)
        self.chart = CylindricalChart(max(part.radius_mm for part in parts), height_mm, self.radius_mm + 1)
        self.relief_limit_mm = relief_limit(2 * self.radius_mm)
        if hollow is not None:
            self.relief_limit_mm = min(self.relief_limit_mm, (self.radius_mm - hollow.radius_mm) / 2)
            self.mask_slope = 1 / (0.6 * (self.radius_mm - hollow.radius_mm))
        self._cut_top = len(parts) > 1 or parts[0].top_mm > height_mm

    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return a lower bound on the signed distance."""
        r = length(x, y)
        distance = self.parts[0].distance(r, z)
        for part in self.parts[1:]:
            distance = smooth_min(distance, part.distance(r, z), self.blend_mm)
        if self.hollow is not None:
            distance = np.maximum(distance, -self.hollow.distance(r, z))
        if self._cut_top:
            distance = np.maximum(distance, z - np.float32(self.height_mm))
        return np.maximum(distance, -z)

    def mask(self, x: Floats, y: Floats, z: Floats) -> Floats | None:
        """Return 0 inside the hollow, 1 on the outer wall; None without a hollow."""
        if self.hollow is None:
            return None
        inner = length(x, y) - np.float32(self.hollow.radius_mm)
        weight: Floats = np.clip(inner * np.float32(self.mask_slope), 0, 1)
        return weight


class ThreadedRod(Revolution):
    """A cylinder with a screw thread on a foot without thread.

    `radius_mm` is that of the crests, `depth_mm` the depth of the trapezoidal profile, `starts` the number of threads.
    """

    def __init__(
        self, radius_mm: float, height_mm: float, *, pitch_mm: float, depth_mm: float, starts: int, foot: Profile
    ) -> None:
        super().__init__((Drum(radius_mm, 0, height_mm, rim_mm=min(1.5, radius_mm / 4)), foot), height_mm, blend_mm=1)
        self.chart = CylindricalChart(radius_mm, height_mm, self.radius_mm + 1)
        self.pitch_mm, self.depth_mm, self.starts, self.foot = pitch_mm, depth_mm, starts, foot
        self.relief_limit_mm = min(0.25, relief_limit(2 * radius_mm))

    def wall_pattern(self, s: Floats, t: Floats) -> Floats | None:
        """Return the height (len(t), len(s)) of the thread, 0 at the crests."""
        phase = t[:, None] / self.pitch_mm - self.starts * s[None, :] / self.chart.width_mm
        wave = np.abs(2 * (phase - np.floor(phase)) - 1).astype(np.float32)
        # Flanks at 30 degrees to the radius need half a pitch for the depth of an ISO thread; crests are flat.
        free = np.clip((t - self.foot.top_mm) / self.pitch_mm, 0, 1).astype(np.float32)
        return np.asarray(-np.float32(self.depth_mm) * free[:, None] * (1 - np.clip(wave * 1.4 - 0.2, 0, 1)))


class FlutedCylinder(Revolution):
    """A cylinder with lobes around it, straight or twisted: a knob, a column, a grip.

    It has `count` lobes, `depth_mm` deep and twisted by `turns` lobes over the height; `sharpness` is the exponent of
    their profile.
    """

    def __init__(self, drum: Drum, *, count: int, depth_mm: float, turns: float = 0.0, sharpness: float = 1.0) -> None:
        super().__init__((drum,), drum.top_mm)
        self.count, self.depth_mm, self.turns, self.sharpness = count, depth_mm, turns, sharpness
        self.relief_limit_mm = min(self.relief_limit_mm, 1.0)

    def wall_pattern(self, s: Floats, t: Floats) -> Floats | None:
        """Return the height (len(t), len(s)) of the lobes, 0 at their tops."""
        phase = self.count * s[None, :] / self.chart.width_mm + self.turns * t[:, None] / self.height_mm
        wave = np.abs(np.sin(np.pi * phase)) ** self.sharpness
        return np.asarray(-self.depth_mm * (1 - wave), np.float32)
