"""Grasps of a mesh as it rests on the table: opposite sides that parallel jaws reach from above or from a side.

Rays along each closing direction meet the mesh on a grid. A pad rests on what comes nearest to it. Two pads make an
antipodal grasp if the line between their contacts, and the mean normal of each contact, lie within the friction cone
(Nguyen 1988). Fingers and hand are boxes, which sweep over neither the object nor the table as they come.
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
from robot.sim.pinch import PAD_MM

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FRICTION = 0.3
"""The least that any material of the simulated rig has."""

SIDEWAYS_RAD = math.pi / 2
_PITCH_MM = 3.0
_YAWS = np.radians(np.arange(0.0, 180.0, 10.0))
_COMPLIANCE_MM = 2.0
"""What lies so far behind a contact's foremost point touches as well: the gel yields, and the jaws turn the object."""

_MIN_CONTACT = 0.2
"""Share of a pad that must touch: an edge between the pads would slip out."""

_HAND_MM, _TABLE_CLEARANCE_MM = 50.0, 5.0
"""Width of the hand behind the fingers, across the closing direction; how far it stays above the table."""

_CALIBRATION_ERROR_MM = 9.0
"""A grasp is the better for holding when the hand arrives so far beside it, as the camera's calibration has it."""

_WORKSPACE_RADIUS_MM = 180.0
"""Contacts farther from the object's middle are outside the workspace."""


@dataclass(frozen=True, eq=False)
class AntipodalGrasps:
    """Grasps (N,) in the object's frame: points (N, 3) between the fingertips, yaw and tilt as of Pose, the width
    between the contacts, and retreat_mm, how far the fingers withdraw from there until they are clear of the object.

    min_width_mm: the least width between opposite sides, within reach or not; inf where there are no such sides.
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
    """Find all grasps on a grid of places and closing directions, from above and from both sides of each."""
    parts: list[tuple[Array, ...]] = []
    narrowest = math.inf
    for yaw in _YAWS:
        outline = _JawProfile.of(body, float(yaw), settings.floor_mm)
        for tilt in (0.0, SIDEWAYS_RAD, -SIDEWAYS_RAD):
            pads = outline.pads(tilt)
            narrowest = min(narrowest, float(pads.width_mm[pads.opposite].min(initial=math.inf)))
            clear, retreat_mm = outline.approach(tilt, pads, settings, stroke_mm)
            at = np.nonzero(_interior(pads.opposite & clear))
            angles = (np.full(len(at[0]), angle) for angle in (yaw, tilt))
            parts.append((outline.points(at, pads.middle_mm), *angles, pads.width_mm[at], retreat_mm[at]))
    points, yaws, tilts, widths, backs = (np.concatenate(part) for part in zip(*parts, strict=True))
    return AntipodalGrasps(points, yaws, tilts, widths, backs, narrowest)


@dataclass(frozen=True, eq=False)
class _PadContacts:
    """Two pads that close at each place (H, Z): whether they meet opposite sides, how far these are apart, and where
    between them the middle lies along the closing direction.
    """

    opposite: Mask
    width_mm: Array
    middle_mm: Array


@dataclass(frozen=True, eq=False)
class _JawProfile:
    """The object as jaws meet it that close at `yaw_rad`, on a grid of places: across (H,) and up (Z,), in mm.

    reach_mm (2, H, Z): how far it extends along the closing direction and against it, -inf where it is not. slopes (2,
    2, H, Z): tangents across and up of its normal there. extent_mm: least and greatest place across.
    """

    yaw_rad: float
    across_mm: Array
    up_mm: Array
    reach_mm: Array
    slopes: Array
    extent_mm: tuple[float, float]

    @classmethod
    def of(cls, body: MeshBody, yaw_rad: float, floor_mm: float) -> "_JawProfile":
        """Cast rays from both sides. Grid points lie at floor_mm, too."""
        closing = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
        sideways = np.array([-closing[1], closing[0], 0.0])
        vertices = body.mesh.vertices
        places = vertices @ sideways
        low, high = float(places.min()), float(places.max())
        first, last = (
            math.ceil(max(low, -_WORKSPACE_RADIUS_MM) / _PITCH_MM),
            math.floor(min(high, _WORKSPACE_RADIUS_MM) / _PITCH_MM),
        )
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
            normal = body.mesh.face_normals[face[hit]]
            slopes[side][:, hit] = (normal @ np.stack([sideways, [0.0, 0.0, 1.0]], 1)).T / np.maximum(
                normal @ direction, 0.05
            )
        shape = len(across), len(up)
        return cls(yaw_rad, across, up, reach.reshape(2, *shape), slopes.reshape(2, 2, *shape), (low, high))

    def pads(self, tilt_rad: float) -> _PadContacts:
        """What two pads meet, with their long side across the approach."""
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
        with np.errstate(invalid="ignore"):  # of places beside the object
            opposite = (
                (width > 0)
                & (count >= _MIN_CONTACT * math.prod(cells)).all(axis=0)
                & (np.hypot(*(centre[:, 0] - centre[:, 1])) <= FRICTION * width)
                & (np.hypot(*slope) <= FRICTION).all(axis=0)
            )
            return _PadContacts(opposite, width, (foremost[0] - foremost[1]) / 2)

    def approach(
        self, tilt_rad: float, pads: _PadContacts, settings: GraspSettings, stroke_mm: float
    ) -> tuple[Mask, Array]:
        """(H, Z) which places open jaws reach, and how far (mm) they withdraw from each to be clear of the object."""
        top = float(self.up_mm[-1])
        lowest, highest = settings.floor_mm, max(settings.floor_mm, top - settings.top_margin_mm)
        if tilt_rad:
            lowest, highest = _HAND_MM / 2 + _TABLE_CLEARANCE_MM, top
        back, end = self._retreat_axis(tilt_rad)
        clear = _clear_places(
            _along_approach(self.reach_mm, tilt_rad),
            _along_approach(pads.middle_mm, tilt_rad),
            back,
            settings,
            stroke_mm,
        )
        withdrawn = np.broadcast_to(end - back + settings.floor_mm + settings.clearance_mm, clear.shape)
        within = (self.up_mm >= lowest) & (self.up_mm <= highest)
        return _along_approach(clear, tilt_rad, back=True) & within, _along_approach(withdrawn, tilt_rad, back=True)

    def _retreat_axis(self, tilt_rad: float) -> tuple[Array, float]:
        """Places against the direction of the approach, rising, and where the object ends that way."""
        if not tilt_rad:
            return self.up_mm, float(self.up_mm[-1])
        return (-self.across_mm[::-1], -self.extent_mm[0]) if tilt_rad > 0 else (self.across_mm, self.extent_mm[1])

    def points(self, at: tuple[NDArray[np.intp], ...], middle_mm: Array) -> Array:
        """(N, 3): the points between the fingertips at these places, in the object's frame."""
        u, v = middle_mm[at], self.across_mm[at[0]]
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.stack([c * u - s * v, s * u + c * v, self.up_mm[at[1]]], axis=1)


def _interior(mask: Mask) -> Mask:
    """The places of a mask (H, Z) whose neighbours across are in it, too; all of them where there is no such place."""
    inner = np.asarray(
        minimum_filter1d(mask, 2 * round(_CALIBRATION_ERROR_MM / _PITCH_MM) + 1, axis=0, mode="constant", cval=0)
    )
    return inner if inner.any() else mask


def _windows(array: Array, cells: tuple[int, int], beyond: float) -> Array:
    """(..., H, Z, *cells): what surrounds each place, `beyond` the border."""
    around = [(0, 0)] * (array.ndim - 2) + [(size // 2, size // 2) for size in cells]
    return sliding_window_view(np.pad(array, around, constant_values=beyond), cells, axis=(-2, -1))


def _along_approach(array: NDArray[Any], tilt_rad: float, back: bool = False) -> NDArray[Any]:
    """(..., H, Z) as (..., across the approach, against it); `back`: the other way round."""
    if not tilt_rad:
        return array
    if back:
        return (array[..., ::-1] if tilt_rad > 0 else array).swapaxes(-1, -2)
    turned = array.swapaxes(-1, -2)
    return turned[..., ::-1] if tilt_rad > 0 else turned


def _clear_places(
    reach_mm: Array, middle_mm: Array, retreat_mm: Array, settings: GraspSettings, stroke_mm: float
) -> Mask:
    """Whether open fingers and the hand behind them come along the last axis, from its end, without meeting the object.

    reach_mm (2, across, along) as of _JawProfile; middle_mm (across, along); retreat_mm (along,), rising.
    """
    beside = _dilated(reach_mm, settings.finger_mm)
    swept = np.maximum.accumulate(beside[..., ::-1], axis=-1)[..., ::-1]
    tips = np.arange(len(retreat_mm)) - math.ceil(settings.floor_mm / _PITCH_MM)
    swept = swept[..., np.maximum(tips, 0)]
    room = stroke_mm / 2 - settings.clearance_mm
    ends = _dilated(np.where(np.isfinite(reach_mm[:1]), retreat_mm, -np.inf).max(axis=-1, keepdims=True), _HAND_MM)[0]
    with np.errstate(invalid="ignore"):  # of places beside the object
        clear = (swept[0] - middle_mm <= room) & (swept[1] + middle_mm <= room)
    return np.asarray(clear & (ends <= retreat_mm + settings.reach_mm))


def _dilated(array: Array, width_mm: float) -> Array:
    """The greatest within a strip of this width across the approach, the axis before the last."""
    cells = 2 * math.ceil(width_mm / _PITCH_MM / 2 - 0.5) + 1
    return np.asarray(maximum_filter1d(array, cells, axis=-2, mode="constant", cval=-np.inf))
