"""Messages of a Sawyer behind rosbridge, and the motion along a line. No socket, no clock.

rosbridge (protocol 2.1) passes the messages of ROS as JSON. Its operations: advertise, publish, subscribe, call_service
and service_response (its id echoed), status. Topics, services and types of the robot are those of the Intera SDK
(intera_core_msgs; names as in intera_sdk 5.3). A message with a missing or invalid value raises DeviceError.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from robot.errors import DeviceError
from robot.readings import Pose

Message = Mapping[str, Any]
T = TypeVar("T")


@dataclass(frozen=True)
class ReceivedMessage:
    """A message of a topic, and its time of arrival on the link's clock."""

    message: Message
    time_s: float


def encode(operation: Message) -> str:
    """Return an operation of rosbridge as JSON; raise DeviceError for values that JSON cannot express, such as NaN."""
    try:
        return json.dumps(operation, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DeviceError(f"rosbridge accepts only plain finite values: {error}") from error


def decode(text: str | bytes) -> Message | None:
    """Return the operation in one websocket message, or None if it is invalid."""
    try:
        operation = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeError):
        return None
    return operation if isinstance(operation, dict) and isinstance(operation.get("op"), str) else None


# The robot's messages -----------------------------------------------------------------------------------------

Joints = npt.NDArray[np.float64]
"""(7,) rad, from the shoulder to the wrist."""

JOINTS = tuple(f"right_j{number}" for number in range(7))
_LIMB = "/robot/limb/right/"
JOINT_STATES = ("/robot/joint_states", "sensor_msgs/JointState")
ROBOT_STATE = ("/robot/state", "intera_core_msgs/RobotAssemblyState")
TIP_STATES = (f"{_LIMB}tip_states", "intera_core_msgs/EndpointStates")
COLLISION = (f"{_LIMB}collision_detection_state", "intera_core_msgs/CollisionDetectionState")
JOINT_COMMAND = (f"{_LIMB}joint_command", "intera_core_msgs/JointCommand")
SPEED_RATIO = (f"{_LIMB}set_speed_ratio", "std_msgs/Float64")
COMMAND_TIMEOUT = (f"{_LIMB}joint_command_timeout", "std_msgs/Float64")
ENABLE = ("/robot/set_super_enable", "std_msgs/Bool")
IK_SERVICE = "/ExternalTools/right/PositionKinematicsNode/IKService"

_SEED_AUTO, _SEED_USER = 0, 1
_IK_FAILURES = {
    -1: "no joint angles reach it",
    -2: "the arm would collide with itself",
    -3: "the robot has no such tip",
}
COLLIDED = "the robot reports a collision and the arm holds: find the contact and free the arm by hand first"
_BUTTON = {0: "not pressed", 1: "pressed", 2: "in an unknown state", 3: "released, but the stop is still active"}
_SOURCE = {0: "nobody", 1: "the red button", 2: "an unknown source", 3: "a motor controller", 4: "the robot's engine"}
_MAX_LEAN_RAD = math.radians(10.0)

_Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]


class _JointState(msgspec.Struct):
    name: list[str]
    position: list[_Number]


class _Point(msgspec.Struct):
    x: _Number
    y: _Number
    z: _Number


class _Quaternion(_Point):
    w: _Number


class _TipPose(msgspec.Struct):
    position: _Point
    orientation: _Quaternion


class _TipState(msgspec.Struct):
    pose: dict[str, Any]


class _TipStates(msgspec.Struct):
    names: list[str]
    states: list[_TipState]


class CollisionState(msgspec.Struct):
    """intera_core_msgs/CollisionDetectionState."""

    collision_state: bool


class _IKAnswer(msgspec.Struct):
    result_type: Annotated[list[int], msgspec.Meta(min_length=1, max_length=1)]
    joints: Annotated[list[_JointState], msgspec.Meta(min_length=1, max_length=1)]


class RobotState(msgspec.Struct, frozen=True):
    """intera_core_msgs/RobotAssemblyState: whether the arm may move, and the reason if not."""

    enabled: bool
    stopped: bool
    error: bool
    estop_button: int
    estop_source: int

    @property
    def blocking_reason(self) -> str | None:
        """Reason why the arm may not move, with the action for a person; None if it may move."""
        if self.stopped:
            source = _SOURCE.get(self.estop_source, "an unknown source")
            button = _BUTTON.get(self.estop_button, "in an unknown state")
            return (
                f"the robot is stopped by {source}, its button is {button}: find the reason, clear the workspace, turn "
                "the button to release it and enable the robot by hand; this program never resets an emergency stop"
            )
        if self.error:
            return "the robot reports an error of one of its parts: read its screen, then reset and enable it by hand"
        if not self.enabled:
            return "the robot is not enabled: clear the workspace and enable it by hand, or set enable = true"
        return None


def parse(message: Message, kind: type[T]) -> T:
    """Return a message as `kind`, a struct of this file; raise DeviceError if it does not fit."""
    try:
        return msgspec.convert(message, kind)
    except msgspec.ValidationError as error:
        raise DeviceError(f"the robot sent an invalid message: {error}, got {str(message)[:200]}") from error


def joints_of(message: Message) -> Joints | None:
    """Parse the arm's joints (7,) of a sensor_msgs/JointState; None for other joints, such as a gripper's."""
    return _arm_joints(parse(message, _JointState))


def _arm_joints(state: _JointState) -> Joints | None:
    angles = dict(zip(state.name, state.position, strict=False))
    return np.array([angles[name] for name in JOINTS]) if angles.keys() >= set(JOINTS) else None


def tip_of(message: Message, tip: str) -> Message:
    """Return the geometry_msgs/Pose of the named tip in an intera_core_msgs/EndpointStates."""
    tips = parse(message, _TipStates)
    poses = dict(zip(tips.names, tips.states, strict=False))
    if tip not in poses:
        known = ", ".join(tips.names)
        raise DeviceError(f"the robot must report its tip {tip!r}, got {known}; set tip to one of these")
    return poses[tip].pose


def joint_command(positions: Joints) -> dict[str, Any]:
    """Return an intera_core_msgs/JointCommand in position mode (rad)."""
    return {
        "mode": 1,  # POSITION_MODE
        "names": list(JOINTS),
        "position": positions.tolist(),
        "velocity": [],
        "acceleration": [],
        "effort": [],
    }


def ik_request(tip_pose: Mapping[str, Any], tip: str, seed: Joints | None) -> dict[str, Any]:
    """Return the arguments of intera_core_msgs/SolvePositionIK for one pose; without a seed the robot chooses one."""
    seeds = [] if seed is None else [{"name": list(JOINTS), "position": seed.tolist(), "velocity": [], "effort": []}]
    return {
        "pose_stamp": [{"header": {"frame_id": "base"}, "pose": dict(tip_pose)}],
        "seed_angles": seeds,
        "seed_mode": _SEED_AUTO if seed is None else _SEED_USER,
        "use_nullspace_goal": [],
        "nullspace_goal": [],
        "nullspace_gain": [],
        "tip_names": [tip],
    }


def ik_answer(values: Message) -> Joints:
    """Parse the joints in the answer to `ik_request`; raise DeviceError if there is no solution."""
    answer = parse(values, _IKAnswer)
    kind = answer.result_type[0]
    joints = _arm_joints(answer.joints[0]) if kind > 0 else None
    if joints is None:
        raise DeviceError(f"IKService: {_IK_FAILURES.get(kind, f'no solution, result type {kind}')}")
    return joints


# Poses of the hand --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mount:
    """Pose of the rig frame in the robot's base frame, and of the gripper on the robot's tip, as in SawyerSettings."""

    base_xyz_mm: tuple[float, float, float]
    base_yaw_rad: float
    tool_mm: float
    tool_yaw_rad: float

    def tip_of(self, pose: Pose) -> dict[str, Any]:
        """Return the geometry_msgs/Pose (m, quaternion) of a tip that points straight down, fingertips at `pose`.

        The tip's rotation is half a turn about x, then an angle about z: the quaternion (cos, sin, 0, 0) of angle / 2.
        """
        point = _about_z(np.array([pose.x_mm, pose.y_mm, pose.z_mm]), self.base_yaw_rad) + self.base_xyz_mm
        x, y, z = (point + np.array([0.0, 0.0, self.tool_mm])).tolist()
        half = (pose.yaw_rad + self.base_yaw_rad + self.tool_yaw_rad) / 2
        return {
            "position": {"x": x / 1000, "y": y / 1000, "z": z / 1000},
            "orientation": {"x": math.cos(half), "y": math.sin(half), "z": 0.0, "w": 0.0},
        }

    def pose_of(self, tip: Mapping[str, Any]) -> Pose:
        """Return the pose of the fingertips for a tip's geometry_msgs/Pose; raise DeviceError if it is tilted."""
        pose = parse(tip, _TipPose)
        place = np.array(msgspec.structs.astuple(pose.position)) * 1000
        quaternion = msgspec.structs.astuple(pose.orientation)
        if abs(math.hypot(*quaternion) - 1.0) > 0.01:
            raise DeviceError(f"the robot's orientation must be a quaternion of length 1, got {quaternion}")
        turn = Rotation.from_quat(quaternion).as_matrix()
        lean = math.acos(min(1.0, max(-1.0, -float(turn[2, 2]))))
        if lean > _MAX_LEAN_RAD:
            raise DeviceError(
                f"the hand must point straight down, but is tilted by {math.degrees(lean):.0f} deg; bring it upright "
                "above the workspace by hand (zero-gravity mode)"
            )
        point = _about_z(place + self.tool_mm * turn[:, 2] - self.base_xyz_mm, -self.base_yaw_rad)
        closing = turn @ [math.cos(self.tool_yaw_rad), math.sin(self.tool_yaw_rad), 0.0]
        yaw = math.remainder(math.atan2(closing[1], closing[0]) - self.base_yaw_rad, math.tau)
        return Pose(float(point[0]), float(point[1]), float(point[2]), yaw)


def _about_z(point: npt.NDArray[np.float64], angle: float) -> npt.NDArray[np.float64]:
    x, y, z = point
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([cosine * x - sine * y, sine * x + cosine * y, z])


# Motion of the hand along a straight line --------------------------------------------------------------------

_RAMP_S = 0.3
"""Duration of the acceleration to full speed."""
STEP_MM, STEP_RAD = 10.0, math.radians(5.0)
"""Largest distance between way-points.

Joints move linearly between two way-points. For an arm of 0.8 m, the hand then deviates from the line by less than
0.1 mm and is at most 1 % faster than requested (a test measures both).
"""


def waypoints(start: Pose, goal: Pose) -> list[Pose]:
    """Return poses from `start` to `goal`, both included; the yaw turns the shorter way."""
    turn = math.remainder(goal.yaw_rad - start.yaw_rad, math.tau)
    length = math.dist(start.as_tuple()[:3], goal.as_tuple()[:3])
    steps = max(1, math.ceil(length / STEP_MM), math.ceil(abs(turn) / STEP_RAD))
    first = np.array([*start.as_tuple()[:3], start.yaw_rad])
    last = np.array([*goal.as_tuple()[:3], start.yaw_rad + turn])
    return [start, *(Pose(*point) for point in np.linspace(first, last, steps + 1)[1:-1].tolist()), goal]


@dataclass(frozen=True)
class JointTrajectory:
    """Joint angles (N, 7) in rad, accelerated to full speed within _RAMP_S, and decelerated.

    `times` (N,) are those in s at which full speed without ramps would reach the way-points.
    """

    joints: Joints
    times: npt.NDArray[np.float64]

    @classmethod
    def from_waypoints(
        cls, poses: Sequence[Pose], joints: Joints, speed_mm_s: float, joint_speed_rad_s: float
    ) -> "JointTrajectory":
        """Return the fastest trajectory within the speeds of the hand and of the joints."""
        lengths = [math.dist(a.as_tuple()[:3], b.as_tuple()[:3]) for a, b in pairwise(poses)]
        turns = np.abs(np.diff(joints, axis=0)).max(1)
        steps = np.maximum(np.array(lengths) / speed_mm_s, turns / joint_speed_rad_s)
        return cls(joints, np.concatenate([[0.0], np.cumsum(steps)]))

    @property
    def duration_s(self) -> float:
        """Time in s until the last angles are commanded."""
        full = float(self.times[-1])
        return full + _RAMP_S if full >= _RAMP_S else 2 * math.sqrt(full * _RAMP_S)

    def at(self, seconds: float) -> Joints:
        """Return the joint angles (7,) at a time after the start."""
        now = self._progress(min(max(seconds, 0.0), self.duration_s))
        return np.array([np.interp(now, self.times, column) for column in self.joints.T])

    def _progress(self, seconds: float) -> float:
        """Return the equivalent time at full speed; its rate rises from 0 to at most 1 and falls, by 1 / _RAMP_S."""
        full, duration = float(self.times[-1]), self.duration_s
        rise = min(_RAMP_S, duration / 2)
        if seconds <= rise:
            return seconds**2 / (2 * _RAMP_S)
        if seconds >= duration - rise:
            return full - (duration - seconds) ** 2 / (2 * _RAMP_S)
        return seconds - _RAMP_S / 2
