"""Driver of a Sawyer behind rosbridge: straight lines by the robot's inverse kinematics, checked at every step.

A motion is planned completely before it begins. IKService solves the way-points of the line, each seeded with the
solution before, with a limited number of tries. Then joint commands in position mode are sent every _TICK_S, along a
trajectory within the requested speed of the hand and `joint_speed_rad_s`; after a pause of the program it continues
where it was. The robot's speed ratio limits it further. Position mode bypasses the robot's collision avoidance (not
detection), so the workspace must be free.

At every step the joint state must be fresh (`max_state_age_s`), the robot enabled, no collision reported and the arm
near its commands; else the arm holds its position. /robot/state and the collision state are slower: they may be 2 s
old. If commands stop (the program or the network failed), the robot ends the motion after _COMMAND_TIMEOUT_S. This
driver never resets an emergency stop.

The link uses `websockets`, because roslibpy sends a message that was published during a connection loss seconds later,
without an error, and drops rosbridge's errors. Here nothing is sent twice and nothing is queued: a lost connection
stays closed, and a new link must be opened.
"""

import contextlib
import itertools
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import numpy as np
from msgspec import Meta

from robot.devices import Arm, Clock
from robot.drivers.sawyer import codec
from robot.drivers.sawyer.codec import (
    Joints,
    JointTrajectory,
    Message,
    Mount,
    ReceivedMessage,
    decode,
    encode,
    joints_of,
    waypoints,
)
from robot.errors import DeviceError
from robot.extras import import_extra
from robot.readings import Pose, Region
from robot.settings import TypedSettings

T = TypeVar("T")
_LOG = logging.getLogger(__name__)

# The link -----------------------------------------------------------------------------------------------------

_MAX_MESSAGES = 200
"""Number of buffered messages of each topic: two seconds at 100 Hz."""
_MAX_ERROR_CHARACTERS = 300
"""Number of characters of an error message that are passed on."""
_PING_S = 5.0


class RosbridgeLink:
    """A connection to `ws://host:port`; every wait ends after `timeout_s` at the latest."""

    def __init__(self, url: str, *, timeout_s: float = 2.0, clock: Clock = time.monotonic) -> None:
        self.url, self.timeout_s, self.clock = url, timeout_s, clock
        self._changed = threading.Condition()
        self._numbers = itertools.count(1)
        self._topics: dict[str, deque[ReceivedMessage]] = {}
        self._replies: dict[str, Message | None] = {}
        self._contexts = contextlib.ExitStack()
        self._socket: Any = None
        self._reader: threading.Thread | None = None
        self._closed_reason = "it was never opened"

    def open(self) -> None:
        """Connect, once only, or raise DeviceError; a closed link cannot be opened again."""
        connect = import_extra("websockets.sync.client", "rosbridge", "sawyer", DeviceError).connect
        try:
            connection = connect(
                self.url,
                open_timeout=self.timeout_s,
                close_timeout=1.0,
                ping_interval=_PING_S,
                ping_timeout=_PING_S,
                compression=None,  # latency matters more than size
                proxy=None,
            )
            self._socket = self._contexts.enter_context(connection)  # websockets 17 requires a context
        except Exception as error:  # websockets raises its own exceptions and OSError
            raise DeviceError(
                f"rosbridge must answer at {self.url}, got {str(error) or type(error).__name__}; start it on the "
                "robot's ROS machine with: roslaunch rosbridge_server rosbridge_websocket.launch"
            ) from error
        self._closed_reason = ""
        self._reader = threading.Thread(target=self._listen, name=f"rosbridge {self.url}", daemon=True)
        self._reader.start()

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        self._mark_closed("it was closed")
        with contextlib.suppress(Exception):  # errors of the closing handshake
            self._contexts.close()
        if self._reader is not None:
            self._reader.join(self.timeout_s)

    def check(self) -> None:
        """Raise DeviceError unless the connection is open."""
        if self._closed_reason:
            raise DeviceError(f"the connection to rosbridge at {self.url} is closed: {self._closed_reason}")

    def subscribe(self, topic: str, kind: str) -> None:
        """Subscribe to a topic of ROS type `kind`; if the link is slow, older messages are dropped."""
        self._topics[topic] = deque(maxlen=_MAX_MESSAGES)
        self._send({"op": "subscribe", "topic": topic, "type": kind, "throttle_rate": 0, "queue_length": 1})

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Advertise a topic of ROS type `kind`; with `latch`, ROS sends the last message to later subscribers."""
        self._send({"op": "advertise", "topic": topic, "type": kind, "latch": latch})

    def publish(self, topic: str, message: Message) -> None:
        """Send a message now; raise DeviceError if this fails."""
        self._send({"op": "publish", "topic": topic, "msg": message})

    def call(self, service: str, arguments: Message) -> Message:
        """Call a ROS service once and return its values; raise DeviceError if it fails or does not answer in time."""
        identity = f"{service}#{next(self._numbers)}"
        with self._changed:
            self._replies[identity] = None
        try:
            self._send({"op": "call_service", "id": identity, "service": service, "args": arguments})
            reply = self._wait(lambda: self._replies[identity], f"answer of {service}")
        finally:
            with self._changed:
                del self._replies[identity]
        values = reply.get("values")
        if reply.get("result", True) is not True or not isinstance(values, dict):
            raise DeviceError(f"{service} failed: {_shorten(values)}")
        return values

    def history(self, topic: str) -> list[ReceivedMessage]:
        """Return the buffered messages of a subscribed topic, oldest first."""
        with self._changed:
            return list(self._topics.get(topic, ()))

    def wait_for(self, topic: str, *, since_s: float = float("-inf")) -> ReceivedMessage:
        """Wait for a message of a topic after `since_s` and return the newest; raise DeviceError if none arrives."""

        def fresh() -> ReceivedMessage | None:
            arrivals = self._topics.get(topic)
            return arrivals[-1] if arrivals and arrivals[-1].time_s > since_s else None

        return self._wait(fresh, f"message on {topic}")

    def _wait(self, found: Callable[[], T | None], what: str) -> T:
        with self._changed:
            self._changed.wait_for(lambda: self._closed_reason or found() is not None, self.timeout_s)
            answer = found()
        if answer is None:
            self.check()
            raise DeviceError(
                f"rosbridge at {self.url}: no {what} within {self.timeout_s:g} s; is the robot's node running?"
            )
        return answer

    def _send(self, operation: Message) -> None:
        text = encode(operation)
        self.check()
        try:
            self._socket.send(text)
        except Exception as error:
            self._mark_closed(str(error) or type(error).__name__)
            raise DeviceError(f"the connection to rosbridge at {self.url} is closed: {self._closed_reason}") from error

    def _listen(self) -> None:
        reason = "the other side closed it"
        try:
            for text in self._socket:
                self._handle(text)
        except Exception as error:
            reason = str(error) or type(error).__name__
        self._mark_closed(reason)

    def _mark_closed(self, reason: str) -> None:
        with self._changed:
            self._closed_reason = self._closed_reason or reason
            self._changed.notify_all()

    def _handle(self, text: str | bytes) -> None:
        """Store a message of a topic or the answer of a call; log errors of rosbridge; ignore all else."""
        operation = decode(text) or {}
        kind, message = operation.get("op"), operation.get("msg")
        identity, topic = str(operation.get("id")), str(operation.get("topic"))
        with self._changed:
            if kind == "publish" and isinstance(message, dict) and topic in self._topics:
                self._topics[topic].append(ReceivedMessage(message, self.clock()))
            elif kind == "service_response" and identity in self._replies:
                self._replies[identity] = operation
            elif kind == "status" and identity in self._replies and operation.get("level") == "error":
                self._replies[identity] = {"result": False, "values": message}
            elif kind == "status":
                _LOG.warning("rosbridge at %s reports: %s", self.url, _shorten(message))
            self._changed.notify_all()


def _shorten(text: object) -> str:
    """Return the truncated text with unprintable characters escaped."""
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in str(text)[:_MAX_ERROR_CHARACTERS])


# The arm ------------------------------------------------------------------------------------------------------

_STATE_TOPICS = (codec.JOINT_STATES, codec.ROBOT_STATE, codec.TIP_STATES, codec.COLLISION)
_SLOW_STATE_AGE_S = 2.0
"""Oldest accepted /robot/state and collision state, which are slower than the joint states."""
_MAX_LAG_RAD = 0.35
"""An arm this far behind its commands is blocked; a lag of half a second at 0.5 rad/s is 0.25 rad."""
_MAX_TURN_RAD = 0.5
"""A larger joint step between two way-points means another branch of the inverse kinematics."""
_STOP_S = 2.0
"""Time in which the arm must become still after a hold command."""
_STILL_RAD, _STILL_S = 1e-3, 0.1
"""An arm is still if no joint moves by more than _STILL_RAD within _STILL_S."""
_TICK_S, _COMMAND_TIMEOUT_S = 0.01, 0.2
"""Time between two commands; time without commands after which the robot ends the motion."""
_ARRIVAL_RAD, _SETTLE_S = 0.01, 5.0
"""Tolerance of every joint at the goal, and time to arrive after the last command."""
_RECONNECT_S = (0.0, 0.25, 1.0, 5.0)
"""Waits before the tries to connect again."""
_MARGIN_MM = 20.0
"""A motion may begin this far outside the workspace, after a stop or a push."""


_Coordinate = Annotated[float, Meta(ge=-1e4, le=1e4)]


@dataclass(frozen=True, kw_only=True)
class SawyerSettings(TypedSettings):
    """Settings of a Sawyer's right arm through rosbridge at host:port.

    Attributes:
        base_xyz_mm: Origin of the rig's frame in the robot's base frame.
        base_yaw_deg: Yaw of the rig's frame in the robot's base frame.
        tool_mm: Distance from the origin of `tip` along its z axis to the point between the fingertips.
        tool_yaw_deg: Angle about z from the tip's x axis to the closing direction of finger a.
        enable: Whether this driver may enable the motors (never during an emergency stop).
        max_state_age_s: An older joint state stops the arm; an older robot or collision state too, but only above 2 s.
    """

    host: str
    base_xyz_mm: tuple[_Coordinate, _Coordinate, _Coordinate]
    tool_mm: Annotated[float, Meta(ge=0, le=1000)]
    port: Annotated[int, Meta(ge=1, le=65535)] = 9090
    tip: str = "right_hand"
    base_yaw_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    tool_yaw_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    speed_ratio: Annotated[float, Meta(ge=0.01, le=1)] = 0.3
    joint_speed_rad_s: Annotated[float, Meta(ge=0.01, le=1.5)] = 0.5
    timeout_s: Annotated[float, Meta(ge=0.05, le=60)] = 2.0
    enable: bool = False
    max_speed_mm_s: float = 200.0
    max_state_age_s: Annotated[float, Meta(ge=0.02, le=5)] = 0.5


class Sawyer(Arm):
    """Sawyer's right arm; the fields of SawyerSettings are keyword arguments of the constructor."""

    Settings = SawyerSettings

    def __init__(self, *, workspace: Region, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Check the settings; raise RobotConfigError for one out of range."""
        options = self._options = SawyerSettings(**settings)
        super().__init__("sawyer", workspace, max_speed_mm_s=options.max_speed_mm_s, clock=clock)
        yaw, tool_yaw = math.radians(options.base_yaw_deg), math.radians(options.tool_yaw_deg)
        self._mount = Mount(options.base_xyz_mm, yaw, options.tool_mm, tool_yaw)
        self._url = f"ws://{options.host}:{options.port}"

    def _connect(self) -> None:
        self._open_link()
        self._make_ready()

    def _open_link(self) -> None:
        """Open a new link and wait for each state once."""
        self._link = RosbridgeLink(self._url, timeout_s=self._options.timeout_s, clock=self.clock)
        self._link.open()
        for topic, kind in _STATE_TOPICS:
            self._link.subscribe(topic, kind)
        self._link.advertise(*codec.JOINT_COMMAND)
        for topic, _ in _STATE_TOPICS:
            self._link.wait_for(topic)
        settings = (codec.SPEED_RATIO, self._options.speed_ratio), (codec.COMMAND_TIMEOUT, _COMMAND_TIMEOUT_S)
        for topic_and_kind, value in settings:  # the robot does not report them
            self._link.advertise(*topic_and_kind, latch=True)
            self._link.publish(topic_and_kind[0], {"data": value})

    def _make_ready(self) -> None:
        """Enable the motors if allowed and sufficient; raise DeviceError if the arm may not move."""
        state = self._robot_state()
        if self._options.enable and self.may_move and not (state.enabled or state.stopped or state.error):
            _LOG.warning("%s: enabling the motors", self.name)
            self._link.advertise(*codec.ENABLE)
            self._link.publish(codec.ENABLE[0], {"data": True})
            deadline = self.clock() + self._options.timeout_s
            while not self._robot_state().enabled and self.clock() < deadline:
                time.sleep(_TICK_S)
        self._check_free()

    def _close(self) -> None:
        """Close the link; the robot ends a motion of another thread after _COMMAND_TIMEOUT_S."""
        self._link.close()

    def _settings(self) -> dict[str, Any]:
        return {
            "url": self._url,
            "tip": self._options.tip,
            "speed_ratio": self._options.speed_ratio,
            "command_timeout_s": _COMMAND_TIMEOUT_S,
        }

    def _recover(self) -> None:
        """Connect again if the link or a state is lost; raise DeviceError if a person must act."""
        for number, wait_s in enumerate((0.0, *_RECONNECT_S)):
            time.sleep(wait_s)
            try:
                if number:
                    self._open_link()
                self._link.check()
                self._fresh_joints()
                self._robot_state()
                self._collisions()
                break
            except DeviceError as error:
                self._link.close()
                if number == len(_RECONNECT_S):
                    raise
                _LOG.warning("%s: %s; connecting again", self.name, error)
        if self._has_collided_since(-math.inf, newest=True):
            raise DeviceError(f"{self.name}: recovery is refused: {codec.COLLIDED}")
        self._make_ready()

    def _pose(self) -> Pose:
        return self._pose_since(self.clock() - self._options.max_state_age_s)

    def _pose_since(self, since_s: float) -> Pose:
        arrival = self._link.wait_for(codec.TIP_STATES[0], since_s=since_s)
        return self._mount.pose_of(codec.tip_of(arrival.message, self._options.tip))

    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        began = self.clock()
        self._check_free()
        if self._has_collided_since(began, newest=True):
            raise DeviceError(f"{self.name}: {codec.COLLIDED}")
        start = self._fresh_joints()
        here = self._pose()
        if not self.workspace.contains(here, _MARGIN_MM):  # else the line to the goal might leave it
            lower, upper = self.workspace.lower, self.workspace.upper
            raise DeviceError(
                f"{self.name}: the hand must be in the workspace {lower} to {upper} first, but is at {here}; "
                "bring it there by hand, or check base_xyz_mm and tool_mm"
            )
        poses = waypoints(here, pose)
        solved = [start]
        for waypoint in poses[1:]:
            solved.append(self._solve(waypoint, solved[-1], start))
        joints = np.array(solved)
        schedule = JointTrajectory.from_waypoints(poses, joints, speed_mm_s, self._options.joint_speed_rad_s)
        self._follow(schedule, began)
        self._settle(joints[-1], began)
        return self._pose_since(self.clock())

    def _solve(self, pose: Pose, before: Joints, start: Joints) -> Joints:
        """Return the joint angles (7,) of one way-point; after a failure, try another seed."""
        tip = self._mount.tip_of(pose)
        for seed in (before, start, None):
            try:
                request = codec.ik_request(tip, self._options.tip, seed)
                joints = codec.ik_answer(self._link.call(codec.IK_SERVICE, request))
            except DeviceError as error:
                self._link.check()
                problem = str(error)
                continue
            turn = float(np.abs(joints - before).max())
            if turn <= _MAX_TURN_RAD:
                return joints
            problem = f"its solution turns a joint by {turn:.2f} rad at once"
        raise DeviceError(
            f"{self.name}: no solution for {pose} after 3 tries: {problem}; the arm has not moved. "
            "Choose a smaller workspace or check base_xyz_mm and tool_mm"
        )

    def _follow(self, schedule: JointTrajectory, began: float) -> None:
        """Command the trajectory; its time advances by at most two ticks a step, also after a pause of the program."""
        at, last = 0.0, self.clock()
        while True:
            commanded = schedule.at(at)
            self._watch(commanded, began)
            self._command(commanded)
            if at >= schedule.duration_s:
                return
            time.sleep(max(0.0, last + _TICK_S - self.clock()))
            now = self.clock()
            at, last = at + min(now - last, 2 * _TICK_S), now

    def _settle(self, goal: Joints, began: float) -> None:
        """Wait until every joint is within _ARRIVAL_RAD of its goal and still; raise DeviceError after _SETTLE_S.

        A joint at its goal that still trembles after _SETTLE_S is accepted.
        """
        deadline = self.clock() + _SETTLE_S
        while True:
            off = float(np.abs(self._watch(goal, began) - goal).max())
            late = self.clock() > deadline
            if off <= _ARRIVAL_RAD and (late or self._is_still(began)):
                return
            if late:
                raise DeviceError(
                    f"{self.name}: every joint must be within {_ARRIVAL_RAD:g} rad of its goal after "
                    f"{_SETTLE_S:g} s, got {off:.3f} rad; is the arm blocked or the load too heavy?"
                )
            self._command(goal)
            time.sleep(_TICK_S)

    def _is_still(self, since_s: float) -> bool:
        """Return whether the arm was still for the last _STILL_S, by joint states that arrived after `since_s`."""
        now_s = self.clock()
        recent = [
            joints
            for arrival in self._link.history(codec.JOINT_STATES[0])
            if arrival.time_s >= max(since_s, now_s - _STILL_S) and (joints := joints_of(arrival.message)) is not None
        ]
        return now_s - since_s >= _STILL_S and len(recent) >= 3 and float(np.ptp(recent, axis=0).max()) < _STILL_RAD

    def _watch(self, commanded: Joints, began: float) -> Joints:
        """Return the current joints; raise DeviceError if the motion must not continue."""
        self._link.check()
        joints = self._fresh_joints()
        self._check_free()
        if self._has_collided_since(began):
            raise DeviceError(f"{self.name}: {codec.COLLIDED}")
        if (lag := float(np.abs(joints - commanded).max())) > _MAX_LAG_RAD:
            raise DeviceError(
                f"{self.name}: the arm must follow within {_MAX_LAG_RAD} rad, but a joint is {lag:.2f} behind; check "
                "whether it is blocked, or commanded by another program"
            )
        return joints

    def _stop(self) -> None:
        """Hold the joints at their current angles and wait until they are still."""
        self._link.check()
        hold, began = self._fresh_joints(), self.clock()
        while not self._is_still(began):
            if self.clock() - began > _STOP_S:
                raise DeviceError(f"{self.name}: the arm still moves after a hold command; press the emergency stop")
            self._fresh_joints()
            self._command(hold)
            time.sleep(_TICK_S)

    def _command(self, joints: Joints) -> None:
        self._link.publish(codec.JOINT_COMMAND[0], codec.joint_command(joints))

    def _fresh_joints(self) -> Joints:
        """Return the newest joints; raise DeviceError if they are too old."""
        age = "none"
        for arrival in reversed(self._link.history(codec.JOINT_STATES[0])):
            if (joints := joints_of(arrival.message)) is not None:
                age_s = self.clock() - arrival.time_s
                if age_s <= self._options.max_state_age_s:
                    return joints
                age = f"{age_s:.2f} s"
                break
        self._link.check()
        raise DeviceError(
            f"{self.name}: the joint state must be at most {self._options.max_state_age_s:g} s old, got {age}; without "
            f"new commands the robot ends its motion after {_COMMAND_TIMEOUT_S:g} s"
        )

    def _robot_state(self) -> codec.RobotState:
        arrivals = self._link.history(codec.ROBOT_STATE[0])
        self._check_arrives(codec.ROBOT_STATE[0], arrivals, "an emergency stop")
        return codec.parse(arrivals[-1].message, codec.RobotState)

    def _collisions(self) -> Sequence[ReceivedMessage]:
        arrivals = self._link.history(codec.COLLISION[0])
        self._check_arrives(codec.COLLISION[0], arrivals, "a collision")
        return arrivals

    def _check_arrives(self, topic: str, arrivals: Sequence[ReceivedMessage], event: str) -> None:
        limit_s = max(self._options.max_state_age_s, _SLOW_STATE_AGE_S)
        if not arrivals or self.clock() - arrivals[-1].time_s > limit_s:
            self._link.check()
            raise DeviceError(
                f"{self.name}: {topic} must be at most {limit_s:g} s old, but no newer message arrived; without it "
                f"{event} would not be detected"
            )

    def _check_free(self) -> None:
        if blocking_reason := self._robot_state().blocking_reason:
            raise DeviceError(f"{self.name}: {blocking_reason}")

    def _has_collided_since(self, began: float, *, newest: bool = False) -> bool:
        """Return whether any message after `began`, or with `newest` the last one, reports a collision."""
        arrivals = self._collisions()
        checked = arrivals[-1:] if newest else [arrival for arrival in arrivals if arrival.time_s >= began]
        return any(codec.parse(arrival.message, codec.CollisionState).collision_state for arrival in checked)
