"""What the collector asks of arm, gripper, tactile sensors and camera: the contract that every driver honours.

Lengths in mm, forces in N, angles in rad, times in s. The rig's frame has z up, z = 0 the table and its origin at the
centre of the workspace; the camera looks on from the -y side. A force of the gripper is what clamps the object, which
is the force on each finger. Images are uint8 RGB, row 0 on top.

The base classes check what goes in and what comes out and raise DeviceError, so that nothing out of range reaches a
driver and nothing stale reaches a recording; a driver writes `_connect`, `_close` and the few methods that its base
class names with an underscore. It may raise DeviceError or OSError there. A device connects whole or not at all;
closing works at any time, twice, and after a failure.
"""

import contextlib
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from robot.errors import DeviceError, RobotConfigError

MAX_AGE_S = 0.5
_CLOCK_SLACK_S = 0.05
"""A frame may carry a time this far ahead of the clock: two clocks never agree better."""

Clock = Callable[[], float]
Status = Literal["idle", "moving", "holding", "no_part", "part_lost"]
STATUSES: tuple[Status, ...] = ("idle", "moving", "holding", "no_part", "part_lost")


# What devices say ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pose:
    """The point between the fingertips, and the direction (cos yaw, sin yaw) in which the jaws close.

    Finger a pushes along this direction, finger b against it: yaw and yaw + pi swap the fingers.
    """

    x_mm: float
    y_mm: float
    z_mm: float
    yaw_rad: float

    def as_tuple(self) -> tuple[float, float, float, float]:
        """x, y, z in mm and yaw in rad, as a recording holds them."""
        return self.x_mm, self.y_mm, self.z_mm, self.yaw_rad


@dataclass(frozen=True)
class Box:
    """An upright box (mm) in the rig's frame, its faces included."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    def __post_init__(self) -> None:
        """Raises RobotConfigError unless lower < upper, all finite."""
        numbers = [*self.lower, *self.upper]
        if len(numbers) != 6 or not all(map(math.isfinite, numbers)) or not np.less(self.lower, self.upper).all():
            raise RobotConfigError(f"a box must have lower < upper in x, y and z, got {self.lower} and {self.upper}")

    def contains(self, pose: Pose) -> bool:
        """Whether the point of the pose lies in the box."""
        point = pose.as_tuple()[:3]
        return all(low <= value <= high for low, value, high in zip(self.lower, point, self.upper, strict=True))


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of a tactile sensor: (H, W, 3) uint8 RGB, and when it was taken."""

    pixels: npt.NDArray[np.uint8]
    time_s: float


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion, in pixels; the centre of the first pixel is (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        """Raises DeviceError for focal lengths that are not above 0, or numbers that are not finite."""
        if not (0 < self.fx < math.inf and 0 < self.fy < math.inf and math.isfinite(self.cx + self.cy)):
            raise DeviceError(f"intrinsics must be finite, with focal lengths above 0 pixels, got {self}")


@dataclass(frozen=True, eq=False)
class RGBD:
    """Colour (H, W, 3) uint8, and depth along the optical axis (H, W) float32 in METRE, NaN where unknown, or None."""

    colour: npt.NDArray[np.uint8]
    depth_m: npt.NDArray[np.float32] | None
    intrinsics: Intrinsics
    time_s: float


@dataclass(frozen=True)
class GripperState:
    """Distance between the fingers, clamping force, and what the gripper makes of it.

    holding: something is clamped. no_part: the jaws closed and met nothing. part_lost: what was held is gone.
    """

    opening_mm: float
    force_n: float
    status: Status

    def __post_init__(self) -> None:
        """Raises DeviceError for a status that is not of the contract, or numbers that are not finite."""
        if self.status not in STATUSES:
            raise DeviceError(f"a gripper's status must be one of {', '.join(STATUSES)}, got {self.status!r}")
        if not (math.isfinite(self.opening_mm) and math.isfinite(self.force_n)):
            raise DeviceError(f"a gripper must report finite numbers, got {self.opening_mm} mm, {self.force_n} N")


# Devices ---------------------------------------------------------------------------------------------------


class Device(ABC):
    """Something that is connected, used and closed. `clock` counts seconds, the same for all devices of a rig."""

    def __init__(self, name: str, *, clock: Clock = time.monotonic) -> None:
        self.name, self.clock = name, clock
        self._connected = False

    @property
    def is_connected(self) -> bool:
        """Whether the device can be used."""
        return self._connected

    def connect(self) -> None:
        """Connect whole or not at all; a second call does nothing. Raises DeviceError."""
        if self._connected:
            return
        try:
            with self._named_errors("cannot be connected"):
                self._connect()
        except BaseException:
            with contextlib.suppress(Exception):
                self._close()
            raise
        self._connected = True

    def close(self) -> None:
        """Let go of the device; does nothing where it is not connected. Raises DeviceError, and counts as closed."""
        if not self._connected:
            return
        self._connected = False
        with self._named_errors("cannot be closed"):
            self._close()

    def settings(self) -> dict[str, Any]:
        """What the device itself reports of its settings, read back from it, as plain JSON. Raises DeviceError."""
        with self._use("cannot say its settings"):
            return self._settings()

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def _connect(self) -> None:
        """Connect; where this raises, `_close` is called next."""

    @abstractmethod
    def _close(self) -> None:
        """Let go of whatever `_connect` has got hold of, also after it stopped half-way."""

    def _settings(self) -> dict[str, Any]:
        return {}

    @contextlib.contextmanager
    def _use(self, failure: str) -> Iterator[None]:
        if not self._connected:
            raise DeviceError(f"{self.name} must be connected before it is used; call connect() first")
        with self._named_errors(failure):
            yield

    @contextlib.contextmanager
    def _named_errors(self, failure: str) -> Iterator[None]:
        """A DeviceError for what the operating system raises."""
        try:
            yield
        except OSError as error:
            raise DeviceError(f"{self.name} {failure}: {error.strerror or error or type(error).__name__}") from error

    def _check(self, what: str, value: float, low: float, high: float, unit: str) -> float:
        if not low <= value <= high:  # also refuses NaN
            raise DeviceError(f"{self.name}: {what} must be from {low:g} to {high:g} {unit}, got {value:g}")
        return float(value)

    def _check_age(self, time_s: float, max_age_s: float) -> None:
        age = self.clock() - time_s
        if not -_CLOCK_SLACK_S <= age <= max_age_s:
            raise DeviceError(
                f"{self.name}: the frame must be at most {max_age_s:g} s old, it is {age:.3g} s; is the stream frozen?"
            )


class Arm(Device):
    """Moves the gripper, held upright, inside `workspace` (limits of the point between the fingertips)."""

    def __init__(
        self, name: str, workspace: Box, *, max_speed_mm_s: float = 1000.0, clock: Clock = time.monotonic
    ) -> None:
        super().__init__(name, clock=clock)
        self.workspace, self.max_speed_mm_s = workspace, max_speed_mm_s

    def move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        """Go there and return the pose reached. Raises DeviceError, also for a pose outside the workspace."""
        with self._use("cannot move"):
            if not self.workspace.contains(pose) or not math.isfinite(pose.yaw_rad):
                lower, upper = self.workspace.lower, self.workspace.upper
                raise DeviceError(f"{self.name}: a pose must be in the workspace {lower} to {upper}, got {pose}")
            self._check("speed", speed_mm_s, 1e-3, self.max_speed_mm_s, "mm/s")
            return self._reached(self._move_to(pose, speed_mm_s))

    def pose(self) -> Pose:
        """Where the arm is now. Raises DeviceError."""
        with self._use("cannot say where it is"):
            return self._reached(self._pose())

    def _reached(self, pose: Pose) -> Pose:
        if not all(map(math.isfinite, pose.as_tuple())):
            raise DeviceError(f"{self.name}: the pose that an arm reports must be finite, got {pose}")
        return pose

    @abstractmethod
    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        """Return when the arm is there; on any exception, KeyboardInterrupt included, leave it standing still."""

    @abstractmethod
    def _pose(self) -> Pose: ...


class Gripper(Device):
    """Two parallel jaws, `stroke_mm` apart at most, that clamp with `min_force_n` to `max_force_n`."""

    def __init__(
        self,
        name: str,
        *,
        stroke_mm: float,
        min_force_n: float,
        max_force_n: float,
        max_speed_mm_s: float = 420.0,
        clock: Clock = time.monotonic,
    ) -> None:
        super().__init__(name, clock=clock)
        self.stroke_mm, self.max_speed_mm_s = stroke_mm, max_speed_mm_s
        self.min_force_n, self.max_force_n = min_force_n, max_force_n

    def state(self) -> GripperState:
        """What the gripper reports now. Raises DeviceError."""
        with self._use("cannot say its state"):
            return self._state()

    def open(self, opening_mm: float) -> GripperState:
        """Move the jaws apart to `opening_mm`, 0 to the stroke; lets go of what is held. Raises DeviceError."""
        with self._use("cannot open"):
            return self._open(self._check("opening", opening_mm, 0.0, self.stroke_mm, "mm"))

    def grasp(self, force_n: float, speed_mm_s: float = 80.0) -> GripperState:
        """Close until `force_n` is reached or nothing is met; returns when the jaws stand. Raises DeviceError."""
        with self._use("cannot grasp"):
            self._check("force", force_n, self.min_force_n, self.max_force_n, "N")
            self._check("speed", speed_mm_s, 1e-3, self.max_speed_mm_s, "mm/s")
            return self._grasp(float(force_n), float(speed_mm_s))

    @abstractmethod
    def _state(self) -> GripperState: ...

    @abstractmethod
    def _open(self, opening_mm: float) -> GripperState: ...

    @abstractmethod
    def _grasp(self, force_n: float, speed_mm_s: float) -> GripperState: ...


class TactileSensor(Device):
    """The gel of one finger, "a" or "b"."""

    def __init__(self, name: str, finger: str, *, clock: Clock = time.monotonic) -> None:
        super().__init__(name, clock=clock)
        self.finger = finger

    def read(self, max_age_s: float = MAX_AGE_S) -> Frame:
        """The newest picture. Raises DeviceError, also for one older than `max_age_s`."""
        with self._use("cannot be read"):
            frame = self._read()
            _check_colour(self.name, frame.pixels)
            self._check_age(frame.time_s, max_age_s)
            return frame

    @abstractmethod
    def _read(self) -> Frame: ...


class Camera(Device):
    """Looks at the table. `extrinsics` (4, 4): camera frame (x right, y down, z forward; mm) to the rig's frame, as
    calibrated, which may be 5 to 10 mm off."""

    def __init__(self, name: str, extrinsics: npt.ArrayLike, *, clock: Clock = time.monotonic) -> None:
        super().__init__(name, clock=clock)
        self.extrinsics = _rigid(extrinsics)

    def read(self, depth: bool = True, max_age_s: float = MAX_AGE_S) -> RGBD:
        """The newest picture; without `depth` none is computed or returned. Raises DeviceError, also when stale."""
        with self._use("cannot be read"):
            image = self._read(depth)
            _check_colour(self.name, image.colour)
            self._check_age(image.time_s, max_age_s)
            if not depth:
                return replace(image, depth_m=None)
            _check_depth(self.name, image)
            return image

    @abstractmethod
    def _read(self, depth: bool) -> RGBD: ...


def _check_colour(name: str, pixels: npt.NDArray[Any]) -> None:
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        raise DeviceError(f"{name}: a frame must be H x W x 3 uint8, got {pixels.shape} {pixels.dtype}")


def _check_depth(name: str, image: RGBD) -> None:
    depth = image.depth_m
    if depth is None or depth.dtype != np.float32 or depth.shape != image.colour.shape[:2]:
        got = "none" if depth is None else f"{depth.shape} {depth.dtype}"
        raise DeviceError(f"{name}: depth must be float32 of the colour's {image.colour.shape[:2]}, got {got}")


def _rigid(matrix: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Check a rotation and translation; 1e-6 is what a rotation typed with seven digits is off."""
    found = np.asarray(matrix, dtype=np.float64)
    if found.shape != (4, 4) or not np.isfinite(found).all() or not np.array_equal(found[3], [0, 0, 0, 1]):
        raise RobotConfigError(f"extrinsics must be a 4 x 4 rigid transform with last row 0 0 0 1, got {found}")
    rotation = found[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-6) or np.linalg.det(rotation) < 0:
        raise RobotConfigError(f"extrinsics must hold a rotation, got {rotation}")
    return found
