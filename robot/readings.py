"""Readings of devices: poses, pictures and gripper states.

Lengths in mm, forces in N, angles in rad, times in s; coordinate frames as in robot.devices.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from _touch_retrieval.documents import check_fields
from robot.errors import DeviceError, RobotConfigError

GripperStatus = Literal["idle", "moving", "holding", "no_part", "part_lost"]
_Focal = Annotated[float, Meta(gt=0, le=1e6)]
_Centre = Annotated[float, Meta(ge=-1e6, le=1e6)]


@dataclass(frozen=True)
class Pose:
    """Pose of the gripper: the point between the fingertips and the closing direction (cos yaw, sin yaw) of the jaws.

    Finger a pushes along the closing direction, finger b against it. At tilt 0 the fingers point straight down. Tilt
    turns them about the closing direction; at pi / 2 they point along (-sin yaw, cos yaw).

    >>> robot.Pose(120.0, 0.0, 40.0, yaw_rad=0.0).as_tuple()
    (120.0, 0.0, 40.0, 0.0)
    """

    x_mm: float
    y_mm: float
    z_mm: float
    yaw_rad: float
    tilt_rad: float = 0.0

    def as_tuple(self) -> tuple[float, ...]:
        """Return x, y, z, yaw and, unless it is 0, tilt, as a recording stores them."""
        upright = self.x_mm, self.y_mm, self.z_mm, self.yaw_rad
        return (*upright, self.tilt_rad) if self.tilt_rad else upright

    def rotation(self) -> npt.NDArray[np.float64]:
        """Return the (3, 3) rotation from the gripper frame (jaws close along x, fingers along -z) to the rig frame."""
        (c, s), (up, aside) = ((math.cos(angle), math.sin(angle)) for angle in (self.yaw_rad, self.tilt_rad))
        return np.array([[c, -s * up, s * aside], [s, c * up, -c * aside], [0.0, aside, up]])


@dataclass(frozen=True)
class Region:
    """A closed axis-aligned box in the rig's frame, in mm."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    def __post_init__(self) -> None:
        """Raise RobotConfigError unless lower < upper and all numbers are finite."""
        numbers = [*self.lower, *self.upper]
        if len(numbers) != 6 or not all(map(math.isfinite, numbers)) or not np.less(self.lower, self.upper).all():
            raise RobotConfigError(f"a region must have lower < upper in x, y and z, got {self.lower} and {self.upper}")

    def contains(self, pose: Pose, margin_mm: float = 0.0) -> bool:
        """Return whether the point of the pose lies in the box, or at most `margin_mm` beyond each face."""
        sides = zip(self.lower, pose.as_tuple()[:3], self.upper, strict=True)
        return all(low - margin_mm <= value <= high + margin_mm for low, value, high in sides)


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of a tactile sensor: (H, W, 3) uint8 RGB, and the time of exposure in s.

    >>> import numpy as np
    >>> robot.Frame(np.zeros((240, 320, 3), np.uint8), time_s=1.5).pixels.shape
    (240, 320, 3)
    """

    pixels: npt.NDArray[np.uint8]
    time_s: float


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion, in pixels; the centre of the first pixel is (0, 0)."""

    fx: _Focal
    fy: _Focal
    cx: _Centre
    cy: _Centre

    def __post_init__(self) -> None:
        """Raise DeviceError unless focal lengths are above 0 and all numbers are at most a million pixels."""
        check_fields(self, "intrinsics", DeviceError)


@dataclass(frozen=True, eq=False)
class RGBD:
    """A camera picture: (H, W, 3) uint8 RGB; time of exposure; perhaps depth, which requires intrinsics.

    Depth is (H, W) float32 along the optical axis in METRES, NaN where unknown.
    """

    colour: npt.NDArray[np.uint8]
    depth_m: npt.NDArray[np.float32] | None
    intrinsics: Intrinsics | None
    time_s: float


@dataclass(frozen=True)
class GripperState:
    """Distance between the fingers, force on each finger, and status.

    "holding": an object is clamped. "no_part": the jaws closed without contact. "part_lost": the clamped object has
    slipped out. Else "idle" or "moving".
    """

    opening_mm: float
    force_n: float
    status: GripperStatus

    def __post_init__(self) -> None:
        """Raise DeviceError for an unknown status or numbers that are not finite."""
        check_fields(self, "gripper", DeviceError)
