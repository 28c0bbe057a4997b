"""Motion of the hand along a straight line: way-points and the joint trajectory. No robot, no clock."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from robot.readings import Pose

Joints = npt.NDArray[np.float64]

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
    fractions = (number / steps for number in range(1, steps))
    return [start, *(_between(start, goal, turn, fraction) for fraction in fractions), goal]


def _between(start: Pose, goal: Pose, turn: float, fraction: float) -> Pose:
    point = [a + fraction * (b - a) for a, b in zip(start.as_tuple()[:3], goal.as_tuple()[:3], strict=True)]
    return Pose(point[0], point[1], point[2], start.yaw_rad + fraction * turn)


@dataclass(frozen=True)
class JointTrajectory:
    """Joint angles over time, with constant acceleration at both ends.

    Attributes:
        joints: (N, 7) joint angles of the way-points, rad.
        times: (N,) times in s at which full speed without ramps would reach them.
        ramp_s: Duration of the acceleration to full speed, and of the deceleration.
    """

    joints: Joints
    times: npt.NDArray[np.float64]
    ramp_s: float

    @classmethod
    def from_waypoints(
        cls, poses: Sequence[Pose], joints: Joints, speed_mm_s: float, joint_speed_rad_s: float, ramp_s: float
    ) -> "JointTrajectory":
        """Return the fastest trajectory within the speeds of the hand and of the joints."""
        lengths = [math.dist(a.as_tuple()[:3], b.as_tuple()[:3]) for a, b in pairwise(poses)]
        turns = np.abs(np.diff(joints, axis=0)).max(1)
        steps = np.maximum(np.array(lengths) / speed_mm_s, turns / joint_speed_rad_s)
        return cls(joints, np.concatenate([[0.0], np.cumsum(steps)]), ramp_s)

    @property
    def duration_s(self) -> float:
        """Time in s until the last angles are commanded."""
        full = float(self.times[-1])
        return full + self.ramp_s if full >= self.ramp_s else 2 * math.sqrt(full * self.ramp_s)

    def at(self, seconds: float) -> Joints:
        """Return the joint angles (7,) at a time after the start."""
        now = self._progress(min(max(seconds, 0.0), self.duration_s))
        return np.array([np.interp(now, self.times, column) for column in self.joints.T])

    def _progress(self, seconds: float) -> float:
        """Return the equivalent time at full speed; its rate rises from 0 to at most 1 and falls, by 1 / ramp_s."""
        full, duration = float(self.times[-1]), self.duration_s
        if self.ramp_s <= 0:
            return seconds
        rise = min(self.ramp_s, duration / 2)
        if seconds <= rise:
            return seconds**2 / (2 * self.ramp_s)
        if seconds >= duration - rise:
            return full - (duration - seconds) ** 2 / (2 * self.ramp_s)
        return seconds - self.ramp_s / 2
