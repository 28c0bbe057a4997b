"""Arms and grippers that a user's own program moves: a Python object.

    [arm]
    driver = "own"
    robot = "ur_arm:URArm"
    settings = {host = "192.168.1.10"}

The object has these methods, with values in mm, rad, mm/s and N:

    arm       move_to(x_mm, y_mm, z_mm, yaw_rad, speed_mm_s)    return when the arm has arrived
              pose()          -> {"x_mm": ..., "y_mm": ..., "z_mm": ..., "yaw_rad": ...}
    gripper   open(opening_mm, speed_mm_s)                      return when the jaws have stopped
              grasp(force_n, speed_mm_s)                        return when the force is reached or the jaws are closed
              state()         -> {"opening_mm": ..., "force_n": ..., "status": "idle"}
    both      stop()          stop now and stay usable
              recover()       optional: clear a fault where this is safe without a person, else raise an exception
              disconnect()    optional: end the connection

It is made when the rig connects; `settings` are its keyword arguments. Connecting asks for the pose or the state and
moves nothing. The limits of the rig's file hold as for every arm and gripper. An arm that is not near its goal after
`move_to` is an error.
"""

import math
import time
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from _touch_retrieval.documents import Positive, typed
from _touch_retrieval.registry import Registry
from robot.devices import Actuator, Arm, Clock, Gripper
from robot.errors import DeviceError, RobotConfigError, UnknownName
from robot.extras import package_errors
from robot.readings import GripperState, Pose, Region

ROBOTS: "Registry[Callable[..., Any]]" = Registry("robot", "robots", {}, error=UnknownName)
"""Classes and functions that make a user's robot, by entry point or `module:Class`."""

ARRIVED_MM, ARRIVED_DEG = 5.0, 5.0
"""Largest distance and turn between the requested and the reported pose after a motion."""


class OwnDevice(Actuator):
    """The common part of an arm and a gripper that a user's program moves.

    `robot` is a name in ROBOTS or "module:Class": a class or a function that returns the object. `settings` are its
    keyword arguments, `others` those of the base class.
    """

    _methods: ClassVar[tuple[str, ...]]
    _reading: ClassVar[tuple[str, type]]
    """The program's method that reports its pose or state, and what it returns."""
    _program: Any = None

    def __init__(self, *, robot: str, settings: Mapping[str, Any], **others: Any) -> None:
        super().__init__(robot, **others)
        self._make, self._options = ROBOTS.resolve(robot), settings

    def _connect(self) -> None:
        with package_errors(f"{self.name} cannot be made"):
            self._program = self._make(**self._options)
        if lacking := [name for name in self._methods if not callable(getattr(self._program, name, None))]:
            raise DeviceError(
                f"{self.name} must have the methods {', '.join(self._methods)}; it lacks {', '.join(lacking)}"
            )
        self._read()

    def _close(self) -> None:
        try:
            self._call_optional("disconnect")
        finally:
            self._program = None

    def _recover(self) -> None:
        self._call_optional("recover")

    def _stop(self) -> None:
        self._call("stop")

    def _call(self, method: str, **values: float) -> Any:
        """Call a method and return its answer; raise DeviceError or OSError if it fails."""
        with package_errors(f"{method} of {self.name} failed"):
            answer = getattr(self._program, method)(**values)
        if isinstance(answer, Mapping):  # numbers of vendors' packages are often numpy scalars
            return {key: value.item() if hasattr(value, "item") else value for key, value in answer.items()}
        return answer

    def _call_optional(self, method: str) -> None:
        """Call a method if the program has it."""
        if callable(getattr(self._program, method, None)):
            self._call(method)

    def _read(self) -> Any:
        """Ask for the pose or the state; raise DeviceError if it is not one."""
        method, kind = self._reading
        return typed(self._call(method), kind, f"{method} of {self.name}", error=DeviceError)


class OwnArm(OwnDevice, Arm):
    """An arm that a user's program moves; `robot` and `settings` are those of OwnDevice."""

    _methods = ("move_to", "pose", "stop")
    _reading = "pose", Pose
    _pose = OwnDevice._read

    def __init__(
        self,
        *,
        workspace: Region,
        robot: str,
        settings: Mapping[str, Any] = {},
        max_speed_mm_s: float = 1000.0,
        clock: Clock = time.monotonic,
    ) -> None:
        super().__init__(
            robot=robot, settings=settings, clock=clock, workspace=workspace, max_speed_mm_s=max_speed_mm_s
        )

    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        """Move, then compare the reported pose with the requested one."""
        values = {"x_mm": pose.x_mm, "y_mm": pose.y_mm, "z_mm": pose.z_mm, "yaw_rad": pose.yaw_rad}
        self._call("move_to", **values, speed_mm_s=speed_mm_s)
        reached = self.pose()
        off_mm = math.dist(reached.as_tuple()[:3], pose.as_tuple()[:3])
        off_deg = math.degrees(abs(math.remainder(reached.yaw_rad - pose.yaw_rad, math.tau)))
        if off_mm > ARRIVED_MM or off_deg > ARRIVED_DEG:
            raise DeviceError(
                f"{self.name} must be within {ARRIVED_MM:g} mm and {ARRIVED_DEG:g} deg of its goal after move_to, but "
                f"it is {off_mm:.1f} mm and {off_deg:.1f} deg away; move_to must return when the arm has arrived, and "
                "pose must be in the rig's frame"
            )
        return reached


class OwnGripper(OwnDevice, Gripper):
    """A gripper that a user's program moves, at the largest allowed speed when it opens.

    `robot` and `settings` are those of OwnDevice. Forces are those on each finger.
    """

    _methods = ("open", "grasp", "state", "stop")
    _reading = "state", GripperState
    _state = OwnDevice._read

    def __init__(
        self,
        *,
        stroke_mm: Annotated[float, Meta(ge=1, le=1000)],
        min_force_n: Positive,
        robot: str,
        settings: Mapping[str, Any] = {},
        max_force_n: float = 1000.0,
        max_speed_mm_s: float = 420.0,
        clock: Clock = time.monotonic,
    ) -> None:
        """Check the settings; raise RobotConfigError, or UnknownName for a class that cannot be imported."""
        if min_force_n > max_force_n:
            raise RobotConfigError(f"min_force_n must be at most max_force_n, got {min_force_n} and {max_force_n}")
        super().__init__(
            robot=robot,
            settings=settings,
            clock=clock,
            stroke_mm=stroke_mm,
            min_force_n=min_force_n,
            max_force_n=max_force_n,
            max_speed_mm_s=max_speed_mm_s,
        )

    def _open(self, opening_mm: float) -> GripperState:
        self._call("open", opening_mm=opening_mm, speed_mm_s=self.max_speed_mm_s)
        return self.state()

    def _grasp(self, force_n: float, speed_mm_s: float) -> GripperState:
        self._call("grasp", force_n=force_n, speed_mm_s=speed_mm_s)
        return self.state()
