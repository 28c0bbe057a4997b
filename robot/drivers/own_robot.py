"""Arms and grippers that a user's own program moves: a Python object, or an HTTP endpoint.

    [arm]                                 [arm]
    driver = "own"                        driver = "own"
    robot = "ur_arm:URArm"                url = "http://192.168.1.20:8000/arm"
    settings = {host = "192.168.1.10"}

Both have the same methods, with values in mm, rad, mm/s and N:

    arm       move_to(x_mm, y_mm, z_mm, yaw_rad, speed_mm_s)    return when the arm has arrived
              pose()          -> {"x_mm": ..., "y_mm": ..., "z_mm": ..., "yaw_rad": ...}
    gripper   open(opening_mm, speed_mm_s)                      return when the jaws have stopped
              grasp(force_n, speed_mm_s)                        return when the force is reached or the jaws are closed
              state()         -> {"opening_mm": ..., "force_n": ..., "status": "idle"}
    both      stop()          stop now and stay usable
              recover()       optional, Python object only: clear a fault where this is safe without a person, else
                              raise an exception
              disconnect()    optional, Python object only: end the connection

A Python object is made when the rig connects: `settings` are its keyword arguments. An HTTP endpoint gets a POST
request to `url`/`method` with the values as JSON; it answers with JSON, or with an error status and a text.

Connecting asks for the pose or the state and moves nothing. The limits of the rig's file hold as for every arm and
gripper: a pose outside the workspace, or a speed or a force above its limit, is refused before the program is called.
Only `state_age_s` is not used. An arm that is not near its goal after `move_to` is an error.
"""

import contextlib
import json
import math
import time
import urllib.error
import urllib.request
from abc import abstractmethod
from collections.abc import Callable, Mapping
from http.client import HTTPException
from typing import Any, ClassVar, Protocol

from _touch_retrieval.documents import typed
from _touch_retrieval.registry import Registry
from robot.devices import Actuator, Arm, Clock, Gripper
from robot.drivers.vendor import vendor_errors
from robot.errors import DeviceError, RobotConfigError, UnknownName
from robot.readings import GripperState, Pose, Region
from robot.settings import check_range

ROBOTS: "Registry[Callable[..., Any]]" = Registry("robot", "robots", {}, error=UnknownName)
"""Classes and functions that make a user's robot, by entry point or `module:Class`."""

ARRIVED_MM, ARRIVED_DEG = 5.0, 5.0
"""Largest distance and turn between the requested and the reported pose after a motion."""

_STOP_S = 5.0
"""Longest wait for the answer to `stop` and to questions over HTTP."""
_MAX_ANSWER_BYTES = 1_000_000


class RobotLink(Protocol):
    """Calls the methods of a user's robot."""

    def call(self, method: str, **values: float) -> Any:
        """Call a method and return its answer; raise DeviceError or OSError if it fails."""

    def call_optional(self, method: str) -> None:
        """Call a method that a robot may lack."""


class PythonLink:
    """A robot that is a Python object.

    Args:
        robot: Name in ROBOTS or "module:Class"; a class or a function that returns the object.
        settings: Its keyword arguments.
        methods: Methods that the object must have.
    """

    def __init__(self, robot: str, settings: Mapping[str, Any], methods: tuple[str, ...]) -> None:
        with vendor_errors(f"{robot} cannot be made"):
            self._object = ROBOTS.resolve(robot)(**settings)
        self._robot = robot
        if lacking := [name for name in methods if not callable(getattr(self._object, name, None))]:
            self.call_optional("disconnect")
            raise DeviceError(f"{robot} must have the methods {', '.join(methods)}; it lacks {', '.join(lacking)}")

    def call(self, method: str, **values: float) -> Any:
        """Call the method of the object."""
        with vendor_errors(f"{method} of {self._robot} failed"):
            answer = getattr(self._object, method)(**values)
        if isinstance(answer, Mapping):  # numbers of vendors' packages are often numpy scalars
            return {key: value.item() if hasattr(value, "item") else value for key, value in answer.items()}
        return answer

    def call_optional(self, method: str) -> None:
        """Call the method if the object has it."""
        if callable(getattr(self._object, method, None)):
            self.call(method)


class HttpLink:
    """A robot behind an HTTP endpoint, called directly, without the proxies of the environment.

    Args:
        url: Address; a method is called at `url`/`method`.
        timeout_s: Longest wait for the end of a motion.
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        self._url, self._timeout_s = url.rstrip("/"), timeout_s
        self._opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))

    def call(self, method: str, **values: float) -> Any:
        """Send a POST request and return the JSON of the answer; None for an empty answer."""
        address = f"{self._url}/{method}"
        head = {"Content-Type": "application/json"}
        request = urllib.request.Request(address, json.dumps(values).encode(), head, method="POST")
        timeout_s = self._timeout_s if values else min(_STOP_S, self._timeout_s)
        try:
            with self._opener.open(request, timeout=timeout_s) as answer:
                content = answer.read(_MAX_ANSWER_BYTES)
        except urllib.error.HTTPError as error:
            with error, contextlib.suppress(OSError, HTTPException):
                text = " ".join(error.read(500).decode("utf-8", "replace").split())
            raise DeviceError(f"{address} answered {error.code}: {text or error.reason}") from error
        except urllib.error.URLError as error:
            raise DeviceError(f"{address} does not answer ({error.reason}); start it, or correct url") from error
        except HTTPException as error:
            raise DeviceError(f"{address} must answer in HTTP, got {error or type(error).__name__}") from error
        try:
            return json.loads(content) if content else None
        except ValueError as error:
            raise DeviceError(f"{address} must answer with JSON, got {content[:100]!r}") from error

    def call_optional(self, method: str) -> None:
        """Do nothing: an endpoint has no optional methods."""


class LinkedDevice(Actuator):
    """The common part of an arm and a gripper that a user's program moves.

    Args:
        robot: Name in ROBOTS or "module:Class"; empty for an HTTP endpoint.
        settings: Keyword arguments of that class.
        url: Address of the HTTP endpoint; empty for a Python object.
        timeout_s: Longest wait for the end of a motion over HTTP.
        others: Arguments of the base class.
    """

    _methods: ClassVar[tuple[str, ...]]
    _link: RobotLink | None = None

    def __init__(self, *, robot: str, settings: Mapping[str, Any], url: str, timeout_s: float, **others: Any) -> None:
        super().__init__(robot or url, **others)
        self._robot, self._options, self._url, self._timeout_s = robot, settings, url, timeout_s
        if bool(robot) == bool(url):
            raise RobotConfigError(f"give robot or url, and not both; got robot {robot!r} and url {url!r}")
        if robot:
            ROBOTS.resolve(robot)
        elif not url.startswith(("http://", "https://")):
            raise RobotConfigError(f"url must begin with http:// or https://, got {url!r}")
        check_range("timeout_s", timeout_s, 0.1, 3600, "s")

    def _connect(self) -> None:
        if self._robot:
            self._link = PythonLink(self._robot, self._options, self._methods)
        else:
            self._link = HttpLink(self._url, self._timeout_s)
        self._report()

    def _close(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.call_optional("disconnect")

    def _recover(self) -> None:
        assert self._link is not None
        self._link.call_optional("recover")

    def _stop(self) -> None:
        self._call("stop")

    def _call(self, method: str, **values: float) -> Any:
        assert self._link is not None
        return self._link.call(method, **values)

    @abstractmethod
    def _report(self) -> object:
        """Ask for the pose or the state."""


class OwnArm(LinkedDevice, Arm):
    """An arm that a user's program moves.

    Args:
        workspace: Limits of the point between the fingertips.
        robot, settings, url, timeout_s: See LinkedDevice.
        max_speed_mm_s: Upper limit of the speed.
        clock: The rig's clock.
    """

    _methods = ("move_to", "pose", "stop")

    def __init__(
        self,
        *,
        workspace: Region,
        robot: str = "",
        settings: Mapping[str, Any] = {},
        url: str = "",
        timeout_s: float = 60.0,
        max_speed_mm_s: float = 1000.0,
        clock: Clock = time.monotonic,
    ) -> None:
        """Check the settings; raise RobotConfigError, or UnknownName for a class that cannot be imported."""
        limits = {"workspace": workspace, "max_speed_mm_s": max_speed_mm_s}
        super().__init__(robot=robot, settings=settings, url=url, timeout_s=timeout_s, clock=clock, **limits)

    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        """Move, then compare the reported pose with the requested one."""
        values = {"x_mm": pose.x_mm, "y_mm": pose.y_mm, "z_mm": pose.z_mm, "yaw_rad": pose.yaw_rad}
        self._call("move_to", **values, speed_mm_s=speed_mm_s)
        reached = self._pose()
        off_mm = math.dist(reached.as_tuple()[:3], pose.as_tuple()[:3])
        off_deg = math.degrees(abs(math.remainder(reached.yaw_rad - pose.yaw_rad, math.tau)))
        if off_mm > ARRIVED_MM or off_deg > ARRIVED_DEG:
            raise DeviceError(
                f"{self.name} must be within {ARRIVED_MM:g} mm and {ARRIVED_DEG:g} deg of its goal after move_to, but "
                f"it is {off_mm:.1f} mm and {off_deg:.1f} deg away; move_to must return when the arm has arrived, and "
                "pose must be in the rig's frame"
            )
        return reached

    def _pose(self) -> Pose:
        return typed(self._call("pose"), Pose, f"pose of {self.name}", error=DeviceError)

    def _report(self) -> object:
        return self._pose()


class OwnGripper(LinkedDevice, Gripper):
    """A gripper that a user's program moves. The jaws open at the largest allowed speed.

    Args:
        stroke_mm: Largest opening.
        min_force_n: Smallest force on each finger.
        robot, settings, url, timeout_s: See LinkedDevice.
        max_force_n: Upper limit of the force on each finger.
        max_speed_mm_s: Upper limit of the speed of the jaws.
        clock: The rig's clock.
    """

    _methods = ("open", "grasp", "state", "stop")

    def __init__(
        self,
        *,
        stroke_mm: float,
        min_force_n: float,
        robot: str = "",
        settings: Mapping[str, Any] = {},
        url: str = "",
        timeout_s: float = 60.0,
        max_force_n: float = 1000.0,
        max_speed_mm_s: float = 420.0,
        clock: Clock = time.monotonic,
    ) -> None:
        """Check the settings; raise RobotConfigError, or UnknownName for a class that cannot be imported."""
        check_range("stroke_mm", stroke_mm, 1, 1000, "mm")
        check_range("min_force_n", min_force_n, 1e-3, max_force_n, "N")
        forces = {"min_force_n": min_force_n, "max_force_n": max_force_n}
        limits = {"stroke_mm": stroke_mm, "max_speed_mm_s": max_speed_mm_s, **forces}
        super().__init__(robot=robot, settings=settings, url=url, timeout_s=timeout_s, clock=clock, **limits)

    def _state(self) -> GripperState:
        return typed(self._call("state"), GripperState, f"state of {self.name}", error=DeviceError)

    def _open(self, opening_mm: float) -> GripperState:
        self._call("open", opening_mm=opening_mm, speed_mm_s=self.max_speed_mm_s)
        return self._state()

    def _grasp(self, force_n: float, speed_mm_s: float) -> GripperState:
        self._call("grasp", force_n=force_n, speed_mm_s=speed_mm_s)
        return self._state()

    def _report(self) -> object:
        return self._state()
