"""What the collector asks of arm, gripper, tactile sensors and camera: the contract that every driver honours.

Lengths in mm, forces in N, angles in rad, times in s. The rig's frame has z up, z = 0 the table and its origin at the
centre of the workspace; the camera looks on from the -y side. A force of the gripper is what clamps the object, which
is the force on each finger. Images are uint8 RGB, row 0 on top.

The base classes check what goes in and what comes out and raise DeviceError, so that nothing out of range reaches a
driver and nothing stale reaches a recording; a driver writes `_connect`, `_close` and the few methods that its base
class names with an underscore. It may raise DeviceError or OSError there. A device connects whole or not at all;
closing works at any time, twice, and after a failure. What moves is stopped when a call ends with an exception.
"""

import contextlib
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from robot.errors import DeviceError, RobotConfigError
from robot.readings import RGBD, Frame, GripperState, Pose, Region
from robot.settings import TypedSettings

MAX_AGE_S = 0.5
_CLOCK_SLACK_S = 0.05
"""A frame may carry a time this far ahead of the clock: two clocks never agree better."""

Clock = Callable[[], float]


class Device(ABC):
    """Something that is connected, used and closed. `clock` counts seconds, the same for all devices of a rig.

    Settings: the dataclass of a driver's settings, whose fields are keywords of the driver beside those it names.
    """

    Settings: ClassVar[type[TypedSettings] | None] = None

    def __init__(self, name: str, *, clock: Clock = time.monotonic) -> None:
        self.name, self.clock = name, clock
        self.refused: dict[str, str] = {}
        """Settings that the device did not take, each with what it was asked and what it has instead."""
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
        except BaseException as error:
            try:
                self._close()
            except Exception as second:
                error.add_note(f"and while {self.name} was closed: {second}")
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

    def recover(self) -> None:
        """Make the device usable again after a DeviceError, as far as that is safe with nobody near.

        A driver says aloud (logging) what it does. Raises DeviceError where a person must see to it first.
        """
        with self._use("cannot be brought back"):
            self._recover()

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

    def _recover(self) -> None:  # noqa: B027
        """Nothing by default: a device that keeps no fault."""

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


class VirtualDevice(Device):
    """A device that is not there: nothing is to be connected, closed, or stopped where it moves."""

    def _connect(self) -> None: ...

    def _close(self) -> None: ...

    def _stop(self) -> None: ...


class Actuator(Device):
    """Something that moves, at most at `max_speed_mm_s`. An exception, Ctrl-C included, leaves it standing still.

    may_move: whether connecting may move it (to find its reference, say) or let it move (enable its motors).
    """

    may_move: bool = True

    def __init__(self, name: str, *, max_speed_mm_s: float, clock: Clock = time.monotonic) -> None:
        super().__init__(name, clock=clock)
        self.max_speed_mm_s = max_speed_mm_s

    def stop(self) -> None:
        """Stand still now and stay usable. Raises DeviceError."""
        with self._use("cannot be stopped"):
            self._stop()

    @abstractmethod
    def _stop(self) -> None:
        """Also called when it stands still already, and after a command that failed half-way."""

    @contextlib.contextmanager
    def _moving(self, failure: str) -> Iterator[None]:
        """As `_use`, and stops on any exception; what that itself raises is added to it as a note."""
        with self._use(failure):
            try:
                yield
            except BaseException as error:
                try:
                    self._stop()
                except Exception as second:
                    error.add_note(f"and while {self.name} was stopped: {second}")
                raise


class Arm(Actuator):
    """Moves the gripper inside `workspace` (limits of the point between the fingertips).

    by_hand: a person moves it when asked to; no speed is kept then. can_tilt: whether the fingers may point elsewhere
    than straight down.

    >>> with robot.load_rig("sim", seed=0) as rig:
    ...     rig.arm.move_to(rig.home, speed_mm_s=100) == rig.home
    True
    """

    is_manual: ClassVar[bool] = False
    can_tilt: bool = False

    def __init__(
        self, name: str, workspace: Region, *, max_speed_mm_s: float = 1000.0, clock: Clock = time.monotonic
    ) -> None:
        super().__init__(name, max_speed_mm_s=max_speed_mm_s, clock=clock)
        self.workspace = workspace

    def move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        """Go there and return the pose reached. Raises DeviceError, also for a pose outside the workspace."""
        if not self.workspace.contains(pose) or not math.isfinite(pose.yaw_rad):
            lower, upper = self.workspace.lower, self.workspace.upper
            raise DeviceError(f"{self.name}: a pose must be in the workspace {lower} to {upper}, got {pose}")
        if pose.tilt_rad and not self.can_tilt:
            raise DeviceError(f"{self.name} keeps the fingers pointing straight down: tilt must be 0, got {pose}")
        self._check("speed", speed_mm_s, 1e-3, self.max_speed_mm_s, "mm/s")
        with self._moving("cannot move"):
            return self._check_reported(self._move_to(pose, speed_mm_s))

    def pose(self) -> Pose:
        """Where the arm is now. Raises DeviceError."""
        with self._use("cannot say where it is"):
            return self._check_reported(self._pose())

    def _check_reported(self, pose: Pose) -> Pose:
        if not all(map(math.isfinite, pose.as_tuple())):
            raise DeviceError(f"{self.name}: the pose that an arm reports must be finite, got {pose}")
        return pose

    @abstractmethod
    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        """Return when the arm is there."""

    @abstractmethod
    def _pose(self) -> Pose: ...


class Gripper(Actuator):
    """Two parallel jaws, `stroke_mm` apart at most, that clamp with `min_force_n` to `max_force_n`.

    A driver may learn these limits when it connects; they never rise above what it was given.

    >>> with robot.load_rig("sim", seed=0) as rig:
    ...     rig.gripper.grasp(force_n=1e6)
    Traceback (most recent call last):
    robot.errors.DeviceError: simulated gripper: force must be from ... to ... N, got 1e+06
    """

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
        super().__init__(name, max_speed_mm_s=max_speed_mm_s, clock=clock)
        self.min_opening_mm, self.min_speed_mm_s = 0.0, 1e-3
        self.stroke_mm = stroke_mm
        self.min_force_n, self.max_force_n = min_force_n, max_force_n

    def state(self) -> GripperState:
        """What the gripper reports now. Raises DeviceError."""
        with self._use("cannot say its state"):
            return self._state()

    def open(self, opening_mm: float) -> GripperState:
        """Move the jaws apart to `opening_mm`, at most the stroke; lets go of what is held. Raises DeviceError."""
        self._check("opening", opening_mm, self.min_opening_mm, self.stroke_mm, "mm")
        with self._moving("cannot open"):
            return self._open(float(opening_mm))

    def grasp(self, force_n: float, speed_mm_s: float = 80.0) -> GripperState:
        """Close until `force_n` is reached or nothing is met; returns when the jaws stand. Raises DeviceError."""
        self._check("force", force_n, self.min_force_n, self.max_force_n, "N")
        self._check("speed", speed_mm_s, self.min_speed_mm_s, self.max_speed_mm_s, "mm/s")
        with self._moving("cannot grasp"):
            return self._grasp(float(force_n), float(speed_mm_s))

    @abstractmethod
    def _state(self) -> GripperState: ...

    @abstractmethod
    def _open(self, opening_mm: float) -> GripperState: ...

    @abstractmethod
    def _grasp(self, force_n: float, speed_mm_s: float) -> GripperState: ...


class TactileSensor(Device):
    """The gel of one finger, "a" or "b".

    >>> import numpy as np
    >>> class Grey(robot.TactileSensor):  # a driver writes the methods whose names begin with an underscore
    ...     def _connect(self): ...
    ...     def _close(self): ...
    ...     def _read(self):
    ...         return robot.Frame(np.full((120, 160, 3), 128, np.uint8), self.clock())
    >>> with Grey("grey", "a") as sensor:
    ...     sensor.read().pixels.shape
    (120, 160, 3)
    """

    def __init__(self, name: str, finger: str, *, clock: Clock = time.monotonic) -> None:
        super().__init__(name, clock=clock)
        self.finger = finger

    def read(self, max_age_s: float = MAX_AGE_S, near_s: float | None = None) -> Frame:
        """The newest picture, or of those it still has the one taken nearest to `near_s`.

        Raises DeviceError, also for one older than `max_age_s`.
        """
        with self._use("cannot be read"):
            frame = self._read() if near_s is None else self._read_near(near_s)
            _check_colour(self.name, frame.pixels)
            self._check_age(frame.time_s, max_age_s)
            return frame

    @abstractmethod
    def _read(self) -> Frame: ...

    def _read_near(self, time_s: float) -> Frame:
        """The newest by default: a sensor that keeps no older ones."""
        return self._read()


def read_together(sensors: Mapping[str, TactileSensor], max_age_s: float = MAX_AGE_S) -> tuple[dict[str, Frame], float]:
    """A picture of every finger taken as nearly at once as they allow, and how far apart in time they are (s).

    Each is the one nearest to the oldest of the newest. Raises DeviceError.
    """
    newest = {finger: sensor.read(max_age_s) for finger, sensor in sensors.items()}
    common = min(frame.time_s for frame in newest.values())
    frames = {
        finger: frame if frame.time_s == common else sensors[finger].read(max_age_s, near_s=common)
        for finger, frame in newest.items()
    }
    times = [frame.time_s for frame in frames.values()]
    return frames, max(times) - min(times)


class Camera(Device):
    """Looks at the table. `extrinsics` (4, 4): camera frame (x right, y down, z forward; mm) to the rig's frame, as
    calibrated, which may be 5 to 10 mm off. has_depth: without it a grasp cannot be planned from the picture.

    >>> with robot.load_rig("sim", seed=0) as rig:
    ...     rig.prepare(rig.object_ids(1)[0], 0)
    ...     rig.camera.read(depth=False).colour.shape
    (..., ..., 3)
    """

    has_depth: bool = True

    def __init__(self, name: str, extrinsics: npt.ArrayLike, *, clock: Clock = time.monotonic) -> None:
        super().__init__(name, clock=clock)
        self.extrinsics = _check_rigid(extrinsics)

    def read(self, depth: bool = True, max_age_s: float = MAX_AGE_S) -> RGBD:
        """The newest picture; without `depth` none is computed or returned. Raises DeviceError, also when stale."""
        with self._use("cannot be read"):
            if depth and not self.has_depth:
                raise DeviceError(f"{self.name} sees colour only: ask it with depth=False")
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
    if image.intrinsics is None:
        raise DeviceError(f"{name}: a picture with depth must come with its intrinsics")


def _check_rigid(matrix: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Check a rotation and translation; 1e-6 is what a rotation typed with seven digits is off."""
    found = np.asarray(matrix, dtype=np.float64)
    if found.shape != (4, 4) or not np.isfinite(found).all() or not np.array_equal(found[3], [0, 0, 0, 1]):
        raise RobotConfigError(f"extrinsics must be a 4 x 4 rigid transform with last row 0 0 0 1, got {found}")
    rotation = found[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-6) or np.linalg.det(rotation) < 0:
        raise RobotConfigError(f"extrinsics must hold a rotation, got {rotation}")
    return found
