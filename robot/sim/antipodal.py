"""Antipodal grasps of a mesh in its resting pose, for parallel jaws that approach from above or from a side.

Rays along each closing direction meet the mesh on a grid. A pad rests on the surface that is nearest to it. Two pads
form an antipodal grasp if the line between their contacts and the mean normal of each contact lie within the friction
cone (Nguyen 1988). Fingers and hand are boxes; on their approach they must meet neither the object nor the table.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from robot.grasping.settings import GraspSettings
from robot.sim.objects.mesh import MeshBody
from robot.sim.scene import PAD_MM

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FRICTION = 0.3
"""Lowest friction coefficient of any material of the simulated rig."""

SIDEWAYS_RAD = math.pi / 2
_PITCH_MM = 3.0
_YAWS = np.radians(np.arange(0.0, 180.0, 10.0))
_COMPLIANCE_MM = 2.0
"""Points up to this far behind a contact's foremost point also touch: the gel yields, and the jaws turn the object."""

_MIN_CONTACT = 0.2
"""Fraction of a pad that must touch: an edge between the pads would slip out."""

_HAND_MM, _TABLE_CLEARANCE_MM = 50.0, 5.0
"""Width of the hand behind the fingers, across the closing direction; its minimum distance from the table."""

_CALIBRATION_ERROR_MM = 9.0
"""A grasp is preferred if it also holds with an error of the hand of this size, that of the camera's calibration."""

_WORKSPACE_RADIUS_MM = 180.0
"""Contacts farther than this from the object's middle are outside the workspace."""


@dataclass(frozen=True, eq=False)
class AntipodalGrasps:
    """Antipodal grasps of one object, in the object's frame.

    Attributes:
        points: (N, 3) points between the fingertips, mm.
        yaw_rad: (N,) yaw, as in `Pose`.
        tilt_rad: (N,) tilt, as in `Pose`.
        width_mm: (N,) distance between the two contacts.
        retreat_mm: (N,) distance that the fingers withdraw until they are clear of the object.
        min_width_mm: least distance between opposite sides, reachable or not; inf if there are no opposite sides.
    """

    points: Array
    yaw_rad: Array
    tilt_rad: Array
    width_mm: Array
    retreat_mm: Array
    min_width_mm: float

    def __len__(self) -> int:
        return len(self.points)


def find_grasps(body: MeshBody, settings: GraspSettings, stroke_mm: float) -> AntipodalGrasps:
    """Find all grasps on a grid of places and closing directions, from above and from both sides."""
    parts: list[tuple[Array, ...]] = []
    min_width_mm = math.inf
    for yaw in _YAWS:
        profile = _JawProfile.of(body, float(yaw), settings.floor_mm)
        for tilt in (0.0, SIDEWAYS_RAD, -SIDEWAYS_RAD):
            opposite, width_mm, middle_mm = profile.pads(tilt)
            min_width_mm = min(min_width_mm, float(width_mm[opposite].min(initial=math.inf)))
            clear, retreat_mm = profile.approach(tilt, middle_mm, settings, stroke_mm)
            at = np.nonzero(_interior(opposite & clear))
            angles = (np.full(len(at[0]), angle) for angle in (yaw, tilt))
            parts.append((profile.points(at, middle_mm), *angles, width_mm[at], retreat_mm[at]))
    points, yaws, tilts, widths, backs = (np.concatenate(part) for part in zip(*parts, strict=True))
    return AntipodalGrasps(points, yaws, tilts, widths, backs, min_width_mm)


@dataclass(frozen=True, eq=False)
class _JawProfile:
    """Extent of the object along one closing direction, on a grid of places across (H,) and up (Z,), in mm."""

    yaw_rad: float  # of the closing direction
    across_mm: Array  # (H,) places across the closing direction
    up_mm: Array  # (Z,) heights
    reach_mm: Array  # (2, H, Z) extent along the closing direction and against it; -inf where there is no object
    slopes: Array  # (2, 2, H, Z) tangents, across and up, of the surface normal there
    extent_mm: tuple[float, float]  # least and greatest place of the object across

    @classmethod
    def of(cls, body: MeshBody, yaw_rad: float, floor_mm: float) -> "_JawProfile":
        """Cast rays from both sides. One row of grid points lies at floor_mm."""
        closing = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
        sideways = np.array([-closing[1], closing[0], 0.0])
        vertices = body.mesh.vertices
        places = vertices @ sideways
        low, high = float(places.min()), float(places.max())
        first = math.ceil(max(low, -_WORKSPACE_RADIUS_MM) / _PITCH_MM)
        last = math.floor(min(high, _WORKSPACE_RADIUS_MM) / _PITCH_MM)
        across = _PITCH_MM * np.arange(first, last + 1, dtype=np.float64)
        top = max(float(vertices[:, 2].max()), floor_mm)
        up = np.arange(floor_mm % _PITCH_MM or _PITCH_MM, top + 1e-9, _PITCH_MM, dtype=np.float64)
        far = float(np.linalg.norm(vertices[:, :2], axis=1).max()) + 10.0
        grid = (across[:, None, None] * sideways + up[None, :, None] * np.array([0.0, 0.0, 1.0])).reshape(-1, 3)
        reach, slopes = np.full((2, len(grid)), -np.inf), np.zeros((2, 2, len(grid)))
        for side, direction in enumerate((closing, -closing)):
            towards = np.broadcast_to(-direction, grid.shape)
            face, distance = body.first_faces(grid + far * direction, towards)
            hit = np.flatnonzero(face >= 0)
            reach[side, hit] = far - distance
            normal = body.mesh.solid.face_normals[face[hit]]
            tangents = (normal @ np.stack([sideways, [0.0, 0.0, 1.0]], 1)).T
            slopes[side][:, hit] = tangents / np.maximum(normal @ direction, 0.05)
        shape = len(across), len(up)
        return cls(yaw_rad, across, up, reach.reshape(2, *shape), slopes.reshape(2, 2, *shape), (low, high))

    def pads(self, tilt_rad: float) -> tuple[Mask, Array, Array]:
        """Return the contacts of two pads that close at each place (H, Z), their long sides across the approach.

        Returns:
            Whether they meet opposite sides, the distance between these, and the middle along the closing direction.
        """
        along, across = (2 * round(size / _PITCH_MM / 2 - 0.5) + 1 for size in PAD_MM)
        cells = (along, across) if tilt_rad else (across, along)
        reach = _windows(self.reach_mm, cells, -np.inf)
        foremost = reach.max(axis=(-1, -2))
        touching = (reach >= foremost[..., None, None] - _COMPLIANCE_MM) & np.isfinite(reach)
        count = np.maximum(touching.sum(axis=(-1, -2)), 1)
        offsets = np.meshgrid(*(_PITCH_MM * (np.arange(size) - size // 2) for size in cells), indexing="ij")
        centre = np.stack([(touching * offset).sum(axis=(-1, -2)) / count for offset in offsets])
        slope = (touching * _windows(self.slopes, cells, 0.0).swapaxes(0, 1)).sum(axis=(-1, -2)) / count
        width = foremost.sum(axis=0)
        with np.errstate(invalid="ignore"):  # places next to the object
            opposite = (
                (width > 0)
                & (count >= _MIN_CONTACT * math.prod(cells)).all(axis=0)
                & (np.hypot(*(centre[:, 0] - centre[:, 1])) <= FRICTION * width)
                & (np.hypot(*slope) <= FRICTION).all(axis=0)
            )
            return opposite, width, (foremost[0] - foremost[1]) / 2

    def approach(
        self, tilt_rad: float, middle_mm: Array, settings: GraspSettings, stroke_mm: float
    ) -> tuple[Mask, Array]:
        """Return (H, Z) whether open jaws can reach each place, and the distance to withdraw clear of the object."""
        top = float(self.up_mm[-1])
        lowest, highest = settings.floor_mm, max(settings.floor_mm, top - settings.top_margin_mm)
        if tilt_rad:
            lowest, highest = _HAND_MM / 2 + _TABLE_CLEARANCE_MM, top
        back, end = self._retreat_axis(tilt_rad)
        reach, middle = _along_approach(self.reach_mm, tilt_rad), _along_approach(middle_mm, tilt_rad)
        clear = _clear_places(reach, middle, back, settings, stroke_mm)
        withdrawn = np.broadcast_to(end - back + settings.floor_mm + settings.clearance_mm, clear.shape)
        within = (self.up_mm >= lowest) & (self.up_mm <= highest)
        return _along_approach(clear, tilt_rad, back=True) & within, _along_approach(withdrawn, tilt_rad, back=True)

    def _retreat_axis(self, tilt_rad: float) -> tuple[Array, float]:
        """Return the places against the approach direction, rising, and the end of the object in that direction."""
        if not tilt_rad:
            return self.up_mm, float(self.up_mm[-1])
        return (-self.across_mm[::-1], -self.extent_mm[0]) if tilt_rad > 0 else (self.across_mm, self.extent_mm[1])

    def points(self, at: tuple[NDArray[np.intp], ...], middle_mm: Array) -> Array:
        """Return the points (N, 3) between the fingertips at these places, in the object's frame."""
        u, v = middle_mm[at], self.across_mm[at[0]]
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.stack([c * u - s * v, s * u + c * v, self.up_mm[at[1]]], axis=1)


def _interior(mask: Mask) -> Mask:
    """Return the places of a mask (H, Z) whose neighbours across are also set; the whole mask if there are none."""
    inner = np.asarray(
        minimum_filter1d(mask, 2 * round(_CALIBRATION_ERROR_MM / _PITCH_MM) + 1, axis=0, mode="constant", cval=0)
    )
    return inner if inner.any() else mask


def _windows(array: Array, cells: tuple[int, int], beyond: float) -> Array:
    """Return the neighbourhood (..., H, Z, *cells) of each place, with `beyond` outside the border."""
    around = [(0, 0)] * (array.ndim - 2) + [(size // 2, size // 2) for size in cells]
    return sliding_window_view(np.pad(array, around, constant_values=beyond), cells, axis=(-2, -1))


def _along_approach(array: NDArray[Any], tilt_rad: float, back: bool = False) -> NDArray[Any]:
    """Reorder (..., H, Z) to (..., across the approach, against it); with `back`, the other way round."""
    if not tilt_rad:
        return array
    if tilt_rad > 0 and back:
        array = array[..., ::-1]
    turned = array.swapaxes(-1, -2)
    return turned[..., ::-1] if tilt_rad > 0 and not back else turned


def _clear_places(
    reach_mm: Array, middle_mm: Array, retreat_mm: Array, settings: GraspSettings, stroke_mm: float
) -> Mask:
    """Return whether open fingers and the hand behind them can reach each place without touching the object.

    The approach is along the last axis of `reach_mm` (2, across, along) and `middle_mm` (across, along), from its end.
    """
    widened = _dilated(reach_mm, settings.finger_mm)
    swept = np.maximum.accumulate(widened[..., ::-1], axis=-1)[..., ::-1]
    tips = np.arange(len(retreat_mm)) - math.ceil(settings.floor_mm / _PITCH_MM)
    swept = swept[..., np.maximum(tips, 0)]
    room = stroke_mm / 2 - settings.clearance_mm
    ends = _dilated(np.where(np.isfinite(reach_mm[:1]), retreat_mm, -np.inf).max(axis=-1, keepdims=True), _HAND_MM)[0]
    with np.errstate(invalid="ignore"):  # places next to the object
        clear = (swept[0] - middle_mm <= room) & (swept[1] + middle_mm <= room)
    return np.asarray(clear & (ends <= retreat_mm + settings.reach_mm))


def _dilated(array: Array, width_mm: float) -> Array:
    """Return the maximum within a strip of this width across the approach (the last axis but one)."""
    cells = 2 * math.ceil(width_mm / _PITCH_MM / 2 - 0.5) + 1
    return np.asarray(maximum_filter1d(array, cells, axis=-2, mode="constant", cval=-np.inf))
