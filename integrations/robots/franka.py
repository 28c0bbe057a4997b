"""A Franka arm and Franka Hand through franky (pip install franky-control).

[arm] has `driver = "franka:FrankaArm"`, [gripper] `driver = "franka:FrankaHand"`. `tool_mm` is the distance from the
end effector that is set in Franka Desk to the point between the fingertips. The fingers of the Franka Hand move along
the y axis of its end effector, so `tool_yaw_deg` is 90 by default.
"""

import math
import time

import franky

from robot import Arm, Gripper
from robot.drivers.sawyer.codec import Mount
from robot.readings import GripperState

DYNAMICS = 0.2
"""Fraction of the robot's largest acceleration and jerk; the speed is limited in mm/s."""
POLL_S = 0.1
HELD_MM = 0.5
"""The jaws hold an object if they are further open than this after a grasp."""
STROKE_MM, FORCE_N = 80.0, (5.0, 35.0)
"""Largest opening, and range of the force on each finger."""


class FrankaArm(Arm):
    """The arm; the keyword arguments are keys of [arm].

    Args:
        host: Address of the robot.
        origin_mm: Origin of the rig's frame in the robot's base frame.
        tool_mm: Distance from the end effector to the point between the fingertips.
        origin_yaw_deg: Turn of the rig's frame about z in the base frame.
        tool_yaw_deg: Angle from the x axis of the end effector to the closing direction of finger a.
    """

    def __init__(
        self,
        *,
        host: str,
        origin_mm: tuple[float, float, float],
        tool_mm: float = 0.0,
        origin_yaw_deg: float = 0.0,
        tool_yaw_deg: float = 90.0,
        workspace,
        max_speed_mm_s=1000.0,
        clock=time.monotonic,
    ):
        super().__init__("Franka arm", workspace, max_speed_mm_s=max_speed_mm_s, clock=clock)
        self.host = host
        self.mount = Mount(origin_mm, math.radians(origin_yaw_deg), tool_mm, math.radians(tool_yaw_deg))

    def _connect(self):
        self.robot = franky.Robot(self.host)
        self.robot.relative_dynamics_factor = franky.RelativeDynamicsFactor(1.0, DYNAMICS, DYNAMICS)

    def _close(self): ...

    def _move_to(self, pose, speed_mm_s):
        """Move in Cartesian space."""
        tip = self.mount.tip_of(pose)
        self.robot.translation_velocity_limit.set(speed_mm_s / 1000)
        goal = franky.Affine(list(tip["position"].values()), [tip["orientation"][axis] for axis in "xyzw"])
        self.robot.move(franky.CartesianMotion(goal), asynchronous=True)
        while not self.robot.join_motion(POLL_S):  # short waits, so that Ctrl-C works
            pass
        return self._pose()

    def _pose(self):
        tip = self.robot.current_cartesian_state.pose.end_effector_pose
        position, turn = (
            dict(zip(axes, map(float, values), strict=True))
            for axes, values in (("xyz", tip.translation), ("xyzw", tip.quaternion))
        )
        return self.mount.pose_of({"position": position, "orientation": turn})

    def _stop(self):
        self.robot.stop()

    def _recover(self):
        """Clear an error of the robot, such as a reflex at contact."""
        self.robot.recover_from_errors()


class FrankaHand(Gripper):
    """The Franka Hand. Home it in Franka Desk before use: homing moves the jaws.

    The force of `franky` is the gripper's; we take half of it as the force on each finger. Measure it for your hand.

    Args:
        host: Address of the robot, a key of [gripper].
    """

    def __init__(self, *, host: str, max_force_n=FORCE_N[1], max_speed_mm_s=100.0, clock=time.monotonic):
        super().__init__(
            "Franka Hand",
            stroke_mm=STROKE_MM,
            min_force_n=FORCE_N[0],
            max_force_n=min(max_force_n, FORCE_N[1]),
            max_speed_mm_s=max_speed_mm_s,
            clock=clock,
        )
        self.host, self.force_n = host, None

    def _connect(self):
        self.hand = franky.Gripper(self.host)

    def _close(self): ...

    def _open(self, opening_mm):
        self.force_n = None
        if not self.hand.move(opening_mm / 1000, self.max_speed_mm_s / 1000):
            raise RuntimeError(f"the jaws did not reach {opening_mm} mm; home the hand in Franka Desk")
        return self._state()

    def _grasp(self, force_n, speed_mm_s):
        """Close until each finger has the force, at any width."""
        self.force_n = force_n
        width = self.hand.max_width
        self.hand.grasp(0.0, speed_mm_s / 1000, 2 * force_n, epsilon_inner=width, epsilon_outer=width)
        return self._state()

    def _state(self):
        opening_mm = 1000 * self.hand.width
        if self.force_n is None:
            status = "idle"
        elif opening_mm <= HELD_MM:
            status = "no_part"
        else:
            status = "holding" if self.hand.is_grasped else "part_lost"
        return GripperState(opening_mm, self.force_n if status == "holding" else 0.0, status)

    def _stop(self):
        self.hand.stop()
