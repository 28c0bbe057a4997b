"""Base classes of arm, gripper, tactile sensor and camera: the contract between the collector and every driver.

Lengths in mm, forces in N, angles in rad, times in s. The origin of the rig's frame lies on the table, by convention at
the centre of the workspace, with z up; the camera stands on the -y side. Every gripper force is the force on each
finger; manufacturers often state the sum over both fingers, twice as much. Images are uint8 RGB, row 0 on top.

The base classes check arguments and results: no value out of range reaches a driver, and no stale frame a recording. A
driver implements `_connect`, `_close` and the abstract methods of its base class, which may raise any exception, such
as those of a vendor's package. All public methods raise DeviceError if they fail.
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

from robot.errors import DeviceError, RobotConfigError, RobotError
from robot.readings import RGBD, Frame, GripperState, Pose, Region
from robot.settings import TypedSettings

MAX_AGE_S = 0.5
_CLOCK_SLACK_S = 0.05
"""A frame's time may be this far ahead of the clock, because two clocks never agree exactly."""
ARRIVED_MM, ARRIVED_DEG = 10.0, 5.0
"""Largest distance and turn between the requested and the reached pose of a motion."""

Clock = Callable[[], float]


class Device(ABC):
    """A device that is connected, used and closed.

    Attributes:
        clock: Time in s, the same for all devices of a rig.
        is_connected: Whether the device can be used.
        refused: Settings that the device refused, each with the requested and the actual value.
        Settings: Dataclass of a driver's settings; its fields are the keyword arguments of the constructor.
    """

    Settings: ClassVar[type[TypedSettings] | None] = None

    def __init__(self, name: str, *, clock: Clock = time.monotonic) -> None:
        self.name, self.clock = name, clock
        self.refused: dict[str, str] = {}
        self.is_connected = False

    def connect(self) -> None:
        """Connect completely or not at all; a second call does nothing."""
        if self.is_connected:
            return
        with _on_error(self._close, f"{self.name} was closed"), self._use("cannot be connected", connected=False):
            self._connect()
        self.is_connected = True

    def close(self) -> None:
        """Close the device if it is connected; it is disconnected afterwards, even if this raises."""
        if not self.is_connected:
            return
        self.is_connected = False
        with self._use("cannot be closed", connected=False):
            self._close()

    def settings(self) -> dict[str, Any]:
        """Return the settings read back from the device, as plain JSON."""
        with self._use("cannot report its settings"):
            return self._settings()

    def recover(self) -> None:
        """Make the device usable again where this is safe without a person, else raise DeviceError; log each action."""
        with self._use("cannot recover"):
            self._recover()

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def _connect(self) -> None:
        """Connect; if this raises, `_close` is called next."""

    @abstractmethod
    def _close(self) -> None:
        """Release all resources of `_connect`, also after it failed midway."""

    def _settings(self) -> dict[str, Any]:
        return {}

    def _recover(self) -> None:  # noqa: B027
        """Do nothing by default, for a device without persistent faults."""

    @contextlib.contextmanager
    def _use(self, failure: str, *, connected: bool = True) -> Iterator[None]:
        """Convert exceptions of a driver into DeviceErrors; with `connected`, require that the device is."""
        if connected and not self.is_connected:
            raise DeviceError(f"{self.name} must be connected before it is used; call connect() first")
        try:
            yield
        except RobotError:
            raise
        except Exception as error:
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise DeviceError(f"{self.name} {failure}: {reason}") from error

    def _check(self, what: str, value: float, low: float, high: float, unit: str) -> None:
        if not low <= value <= high:  # also rejects NaN
            raise DeviceError(f"{self.name}: {what} must be from {low:g} to {high:g} {unit}, got {value:g}")

    def _check_age(self, time_s: float, max_age_s: float) -> None:
        age = self.clock() - time_s
        if not -_CLOCK_SLACK_S <= age <= max_age_s:
            raise DeviceError(
                f"{self.name}: the frame's age must be from {-_CLOCK_SLACK_S:g} to {max_age_s:g} s, got {age:.3g} s; "
                "is the stream frozen?"
            )


@contextlib.contextmanager
def _on_error(action: Callable[[], None], what: str) -> Iterator[None]:
    """Call `action` if the block raises; an exception of the action itself becomes a note."""
    try:
        yield
    except BaseException as error:
        try:
            action()
        except Exception as second:
            error.add_note(f"and while {what}: {second}")
        raise


class VirtualDevice(Device):
    """A simulated device: connect, close and stop do nothing."""

    def _connect(self) -> None: ...

    def _close(self) -> None: ...

    def _stop(self) -> None: ...


class Actuator(Device):
    """A device that moves, at most at `max_speed_mm_s`; an exception during a motion, Ctrl-C included, stops it.

    Attributes:
        max_speed_mm_s: Upper limit of the commanded speed.
        may_move: Whether connecting may move it (homing) or enable its motors.
    """

    may_move: bool = True

    def __init__(self, name: str, *, max_speed_mm_s: float, clock: Clock = time.monotonic) -> None:
        super().__init__(name, clock=clock)
        self.max_speed_mm_s = max_speed_mm_s

    def stop(self) -> None:
        """Stop now and stay usable; a held object may be released."""
        with self._use("cannot be stopped"):
            self._stop()

    @abstractmethod
    def _stop(self) -> None:
        """Stop; also called if the device does not move, and after a command that failed midway."""

    @contextlib.contextmanager
    def _moving(self, failure: str) -> Iterator[None]:
        with self._use(failure), _on_error(self._stop, f"{self.name} was stopped"):
            yield


class Arm(Actuator):
    """An arm that moves the gripper inside `workspace`, the limits of the point between the fingertips.

    Attributes:
        is_manual: Whether a person moves it on request; speeds are not enforced then.
        can_tilt: Whether the fingers may point in other directions than straight down.

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
        """Move to `pose`, inside the workspace, and return the pose reached, at most 10 mm and 5 degrees away."""
        if not self.workspace.contains(pose) or not math.isfinite(pose.yaw_rad):
            raise DeviceError(f"{self.name}: a pose must be in the workspace {self.workspace}, got {pose}")
        if pose.tilt_rad and not self.can_tilt:
            raise DeviceError(f"{self.name}: tilt must be 0, because the fingers always point down; got {pose}")
        self._check("speed", speed_mm_s, 1e-3, self.max_speed_mm_s, "mm/s")
        with self._moving("cannot move"):
            reached = self._check_reported(self._move_to(pose, speed_mm_s))
            off_mm = math.dist(reached.as_tuple()[:3], pose.as_tuple()[:3])
            off_deg = math.degrees(abs(math.remainder(reached.yaw_rad - pose.yaw_rad, math.tau)))
            if off_mm > ARRIVED_MM or off_deg > ARRIVED_DEG:
                raise DeviceError(
                    f"{self.name} must be within {ARRIVED_MM:g} mm and {ARRIVED_DEG:g} deg of its goal after a motion, "
                    f"but it is {off_mm:.1f} mm and {off_deg:.1f} deg away; is it blocked?"
                )
            return reached

    def pose(self) -> Pose:
        """Return the current pose."""
        with self._use("cannot report its pose"):
            return self._check_reported(self._pose())

    def _check_reported(self, pose: Pose) -> Pose:
        if not all(map(math.isfinite, pose.as_tuple())):
            raise DeviceError(f"{self.name}: the reported pose must be finite, got {pose}")
        return pose

    @abstractmethod
    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        """Move, and return the pose when the arm has arrived."""

    @abstractmethod
    def _pose(self) -> Pose:
        """Return the current pose."""


class Gripper(Actuator):
    """A gripper with two parallel jaws, at most `stroke_mm` apart, and `min_force_n` to `max_force_n` on each finger.

    Before connecting, stroke and smallest force may be typical values; once connected, the driver reads the device's.
    The largest force and speed never exceed the configured limits.

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
        self.min_speed_mm_s = 1e-3
        self.stroke_mm = stroke_mm
        self.min_force_n, self.max_force_n = min_force_n, max_force_n

    def state(self) -> GripperState:
        """Return the current state."""
        with self._use("cannot report its state"):
            return self._state()

    def open(self, opening_mm: float) -> GripperState:
        """Open or narrow the jaws to `opening_mm` and return the state; a held object is released."""
        self._check("opening", opening_mm, 0.0, self.stroke_mm, "mm")
        with self._moving("cannot open"):
            return self._open(float(opening_mm))

    def grasp(self, force_n: float, speed_mm_s: float = 80.0) -> GripperState:
        """Close until each finger has `force_n` or the jaws are fully closed; return the state."""
        self._check("force", force_n, self.min_force_n, self.max_force_n, "N")
        self._check("speed", speed_mm_s, self.min_speed_mm_s, self.max_speed_mm_s, "mm/s")
        with self._moving("cannot grasp"):
            return self._grasp(float(force_n), float(speed_mm_s))

    @abstractmethod
    def _state(self) -> GripperState:
        """Return the current state."""

    @abstractmethod
    def _open(self, opening_mm: float) -> GripperState:
        """Move the jaws, and return the state when they have arrived."""

    @abstractmethod
    def _grasp(self, force_n: float, speed_mm_s: float) -> GripperState:
        """Close, and return the state when the jaws have stopped."""


class TactileSensor(Device):
    """The tactile sensor (gel) of one finger, "a" or "b".

    >>> import numpy as np
    >>> class Grey(robot.TactileSensor):  # a driver implements the methods that begin with an underscore
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
        """Return the newest frame, or the buffered one nearest to `near_s`, at most `max_age_s` old."""
        with self._use("cannot be read"):
            frame = self._read() if near_s is None else self._read_near(near_s)
            _check_colour(self.name, frame.pixels)
            self._check_age(frame.time_s, max_age_s)
            return frame

    @abstractmethod
    def _read(self) -> Frame:
        """Return the newest frame."""

    def _read_near(self, time_s: float) -> Frame:
        """Return the newest frame by default, for a sensor that buffers no older ones."""
        return self._read()


def read_together(sensors: Mapping[str, TactileSensor], max_age_s: float = MAX_AGE_S) -> tuple[dict[str, Frame], float]:
    """Read one frame of each sensor, close in time; return the frames by finger and their skew in s.

    The oldest of the sensors' newest frames sets the time. Each other sensor gives its buffered frame nearest to it.
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
    """The camera of the table.

    Attributes:
        extrinsics: (4, 4) calibrated transform from the camera frame (x right, y down, z forward; mm) to the rig's
            frame; its error may be 5 to 10 mm.
        has_depth: Whether it measures depth.

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
        """Return the newest picture, with depth if `depth` is true, at most `max_age_s` old."""
        with self._use("cannot be read"):
            if depth and not self.has_depth:
                raise DeviceError(f"{self.name} has no depth: read it with depth=False")
            image = self._read(depth)
            _check_colour(self.name, image.colour)
            self._check_age(image.time_s, max_age_s)
            if not depth:
                return replace(image, depth_m=None)
            shape, known = image.colour.shape[:2], image.depth_m
            if known is None or known.dtype != np.float32 or known.shape != shape:
                got = "none" if known is None else f"{known.shape} {known.dtype}"
                raise DeviceError(f"{self.name}: depth must be float32 of the picture's shape {shape}, got {got}")
            if image.intrinsics is None:
                raise DeviceError(f"{self.name}: a picture with depth must have intrinsics")
            return image

    @abstractmethod
    def _read(self, depth: bool) -> RGBD:
        """Return the newest picture."""


def _check_colour(name: str, pixels: npt.NDArray[Any]) -> None:
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        raise DeviceError(f"{name}: a frame must be H x W x 3 uint8, got {pixels.shape} {pixels.dtype}")


def _check_rigid(matrix: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Check a rigid transform; the tolerance 1e-6 accepts a rotation that was typed with seven digits."""
    rigid = np.asarray(matrix, dtype=np.float64)
    if rigid.shape != (4, 4) or not np.isfinite(rigid).all() or not np.array_equal(rigid[3], [0, 0, 0, 1]):
        raise RobotConfigError(f"extrinsics must be a 4 x 4 rigid transform with last row 0 0 0 1, got {rigid}")
    rotation = rigid[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-6) or np.linalg.det(rotation) < 0:
        raise RobotConfigError(f"extrinsics must contain a rotation, got {rotation}")
    return rigid
