"""Outlines extruded from the table: boxes, prisms, ovals; tapered or twisted."""

import numpy as np

from robot.sim.objects.shapes.shape import (
    Chart,
    Floats,
    Points,
    Shape,
    arctan2,
    bounds,
    length,
    relief_limit,
    rounded_corner,
    smooth_min,
)


class RoundedRectangle:
    """2 half_x by 2 half_y with corners of radius `corner_mm` > 0; an oval if the radius equals the smaller half."""

    def __init__(self, half_x_mm: float, half_y_mm: float, corner_mm: float) -> None:
        self.reach_x_mm, self.reach_y_mm, self.corner_mm = half_x_mm, half_y_mm, corner_mm
        self._inner = half_x_mm - corner_mm, half_y_mm - corner_mm
        self.radius_mm = float(np.hypot(*self._inner)) + corner_mm
        self.length_mm = 4 * sum(self._inner) + 2 * np.pi * corner_mm

    def distance(self, x: Floats, y: Floats) -> Floats:
        """Return the signed distance in mm."""
        p, q = np.abs(x) - np.float32(self.reach_x_mm), np.abs(y) - np.float32(self.reach_y_mm)
        return rounded_corner(p, q, self.corner_mm)

    def locate(self, x: Floats, y: Floats) -> Floats:
        """Return the arc length from the middle of the back (+y) over the left; s grows to the right in front."""
        a, b = (np.float32(value) for value in self._inner)
        p, q = np.abs(x) - a, np.abs(y) - b
        # Deep inside, the nearer face counts: shift p and q so that the larger one belongs to an edge.
        depth = np.maximum(np.minimum(-p, -q), 0) + np.float32(1e-6)
        angle = arctan2(np.maximum(p + depth, 0), np.maximum(q + depth, 0))
        along = np.clip(a + p, 0, a) + angle * np.float32(self.corner_mm) + np.clip(-q, 0, b)
        quarter = np.float32(self.length_mm / 4)
        s = np.where(y > 0, along, 2 * quarter - along)
        unrolled: Floats = np.where(x > 0, 4 * quarter - s, s)
        return unrolled

    def points_at(self, s: Floats) -> tuple[Points, Points]:
        """Return points and outward normals at arc length s, (N, 2) each."""
        a, b = self._inner
        half = self.length_mm / 2
        folded = np.where(s > half, 2 * half - s, s)
        along = np.where(folded > half / 2, half - folded, folded)
        angle = np.clip((along - a) / self.corner_mm, 0, np.pi / 2)
        straight = np.clip(along - a - self.corner_mm * np.pi / 2, 0, b)
        normal = np.stack([np.sin(angle), np.cos(angle)], axis=1)
        sign = np.stack([np.where(s > half, 1, -1), np.where(folded > half / 2, -1, 1)], axis=1)
        core = np.stack([np.clip(along, 0, a), b - straight], axis=1)
        return sign * (core + self.corner_mm * normal), sign * normal


class Polygon:
    """A regular polygon, `apothem_mm` from its middle to a face, with corners of radius `corner_mm` > 0."""

    def __init__(self, sides: int, apothem_mm: float, corner_mm: float) -> None:
        self.sides, self.apothem_mm, self.corner_mm = sides, apothem_mm, corner_mm
        self.radius_mm = float((apothem_mm - corner_mm) / np.cos(np.pi / sides) + corner_mm)
        self.reach_x_mm = self.reach_y_mm = self.radius_mm
        # Half the length of a face's straight part.
        self._half = float((apothem_mm - corner_mm) * np.tan(np.pi / sides))
        self.length_mm = sides * 2 * self._half + 2 * np.pi * corner_mm

    def _fold(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the face's number, and coordinates along and across it; face 0 is in front (-y)."""
        wedge = np.float32(2 * np.pi / self.sides)
        face = np.rint(arctan2(x, -y) / wedge)
        turn = face * wedge
        sine, cosine = np.sin(turn), np.cos(turn)
        return face, x * cosine + y * sine, x * sine - y * cosine

    def distance(self, x: Floats, y: Floats) -> Floats:
        """Return the signed distance in mm."""
        _, u, v = self._fold(x, y)
        side = np.abs(u) - np.float32(self._half)
        height = v - np.float32(self.apothem_mm - self.corner_mm)
        corner = length(np.maximum(side, 0), np.maximum(height, 0))
        return np.where(height > 0, corner, height) - np.float32(self.corner_mm)

    def locate(self, x: Floats, y: Floats) -> Floats:
        """Return the arc length of the nearest point of the curve."""
        face, u, v = self._fold(x, y)
        side = np.abs(u) - np.float32(self._half)
        height = np.maximum(v - np.float32(self.apothem_mm - self.corner_mm), np.float32(1e-6))
        bend = np.minimum(arctan2(np.maximum(side, 0), height), np.float32(np.pi / self.sides))
        along = np.minimum(np.abs(u), np.float32(self._half)) + bend * np.float32(self.corner_mm)
        s = face * np.float32(self.length_mm / self.sides) + np.copysign(along, u) + np.float32(self.length_mm / 2)
        return np.where(s < 0, s + np.float32(self.length_mm), s)

    def points_at(self, s: Floats) -> tuple[Points, Points]:
        """Return points and outward normals at arc length s, (N, 2) each."""
        shifted = s - self.length_mm / 2
        face = np.rint(shifted / (self.length_mm / self.sides))
        u = shifted - face * (self.length_mm / self.sides)
        bend = np.sign(u) * np.maximum(np.abs(u) - self._half, 0) / self.corner_mm
        turn = face * 2 * np.pi / self.sides
        normal = np.stack([np.sin(turn + bend), -np.cos(turn + bend)], axis=1)
        along, across = np.clip(u, -self._half, self._half), self.apothem_mm - self.corner_mm
        core = np.stack(
            [along * np.cos(turn) + across * np.sin(turn), along * np.sin(turn) - across * np.cos(turn)], axis=1
        )
        return core + self.corner_mm * normal, normal


Outline = RoundedRectangle | Polygon
"""A flat closed curve around the origin, in mm: its extents along x and y, its farthest point, and its arc length."""


class OutlineChart(Chart):
    """s = arc length of an outline, t = z, in the frame of a shape that may shrink and twist with height."""

    def __init__(self, shape: "Extrusion") -> None:
        self._shape = shape
        self.width_mm, self.height_mm = shape.outline.length_mm, shape.height_mm

    def locate(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Return map coordinates of points on or near the wall."""
        u, v, _ = self._shape.straighten(x, y, z)
        return self._shape.outline.locate(u, v), z

    def rays(self, s: Floats, t: Floats) -> tuple[Points, Points]:
        """Return rays towards the wall from outside, at map coordinates (s, t)."""
        point, normal = self._shape.outline.points_at(s)
        start = point * self._shape.scale(t)[:, None] + normal
        turn = self._shape.twist_per_mm * t
        sine, cosine = np.sin(turn), np.cos(turn)
        origins = [start[:, 0] * cosine - start[:, 1] * sine, start[:, 0] * sine + start[:, 1] * cosine, t]
        inward = [normal[:, 1] * sine - normal[:, 0] * cosine, -normal[:, 0] * sine - normal[:, 1] * cosine, 0 * t]
        return np.stack(origins, axis=1), np.stack(inward, axis=1)


class Extrusion(Shape):
    """An outline from z = 0 to `height_mm`, with upper and lower edges rounded by `rim_mm`.

    At the top, the outline is smaller by the fraction `taper` and rotated by `twist_rad`.
    """

    def __init__(
        self, outline: Outline, height_mm: float, *, rim_mm: float = 0.0, taper: float = 0.0, twist_rad: float = 0.0
    ) -> None:
        self.outline, self.height_mm, self.rim_mm, self.taper = outline, height_mm, rim_mm, taper
        self.twist_per_mm = twist_rad / height_mm
        reach = outline.radius_mm
        wide = (outline.reach_x_mm, outline.reach_y_mm) if twist_rad == 0 else (reach, reach)
        self.lower, self.upper = bounds(*wide, height_mm)
        self.chart = OutlineChart(self)
        self._upright = taper == 0 and twist_rad == 0
        # Upper bound on how much faster the straightened point moves than the point itself.
        self._stretch = np.float32(np.hypot(1, reach * taper / height_mm) + reach * abs(self.twist_per_mm))
        narrow = 2 * min(outline.reach_x_mm, outline.reach_y_mm) * (1 - taper)
        self.relief_limit_mm = relief_limit(narrow, (95 - 2 * min(wide)) / 2)

    def scale(self, z: Floats) -> Floats:
        """Return the size of the outline at height z, relative to the base."""
        return 1 - np.float32(self.taper / self.height_mm) * np.clip(z, 0, np.float32(self.height_mm))

    def straighten(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats | None]:
        """Undo twist and taper; return coordinates in the outline's plane, and its relative size (None for 1)."""
        if self.twist_per_mm:
            turn = np.float32(self.twist_per_mm) * np.clip(z, 0, np.float32(self.height_mm))
            sine, cosine = np.sin(turn), np.cos(turn)
            x, y = x * cosine + y * sine, y * cosine - x * sine
        if not self.taper:
            return x, y, None
        size = self.scale(z)
        return x / size, y / size, size

    def distance_xyz(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return a lower bound on the signed distance."""
        u, v, size = self.straighten(x, y, z)
        side = self.outline.distance(u, v)
        if size is not None:
            side = side * size
        half = np.float32(self.height_mm / 2)
        ends = np.abs(z - half) - half
        if self._upright:
            return rounded_corner(side, ends, self.rim_mm)
        # Leaning sides do not meet the ends at right angles, as in Cone.
        return -smooth_min(-side / self._stretch, -ends, 2 * self.rim_mm)
