"""A Franka arm and Franka Hand through franky (pip install franky-control), for `driver = "own"`.

`tool_mm` is the distance from the end effector that is set in Franka Desk to the point between the fingertips. The
fingers of the Franka Hand move along the y axis of its end effector, so `tool_yaw_deg` is 90 by default.
"""

import math

import franky

from robot import Pose
from robot.drivers.sawyer.codec import Mount

DYNAMICS = 0.2
"""Fraction of the robot's largest acceleration and jerk; the speed is limited in mm/s."""
POLL_S = 0.1
HELD_MM = 0.5
"""The jaws hold an object if they are further open than this after a grasp."""


class FrankaArm:
    """The arm.

    Args:
        host: Address of the robot.
        origin_mm: Origin of the rig's frame in the robot's base frame.
        tool_mm: Distance from the end effector to the point between the fingertips.
        origin_yaw_deg: Turn of the rig's frame about z in the base frame.
        tool_yaw_deg: Angle from the x axis of the end effector to the closing direction of finger a.
    """

    def __init__(self, host, origin_mm, tool_mm=0.0, origin_yaw_deg=0.0, tool_yaw_deg=90.0):
        self.mount = Mount(tuple(origin_mm), math.radians(origin_yaw_deg), tool_mm, math.radians(tool_yaw_deg))
        self.robot = franky.Robot(host)
        self.robot.relative_dynamics_factor = franky.RelativeDynamicsFactor(1.0, DYNAMICS, DYNAMICS)

    def move_to(self, x_mm, y_mm, z_mm, yaw_rad, speed_mm_s):
        """Move in Cartesian space; return when the arm has arrived."""
        tip = self.mount.tip_of(Pose(x_mm, y_mm, z_mm, yaw_rad))
        self.robot.translation_velocity_limit.set(speed_mm_s / 1000)
        goal = franky.Affine(list(tip["position"].values()), [tip["orientation"][axis] for axis in "xyzw"])
        self.robot.move(franky.CartesianMotion(goal), asynchronous=True)
        while not self.robot.join_motion(POLL_S):  # short waits, so that Ctrl-C works
            pass

    def pose(self):
        """Return the pose of the point between the fingertips in the rig's frame."""
        tip = self.robot.current_cartesian_state.pose.end_effector_pose
        position, turn = (
            dict(zip(axes, map(float, values), strict=True))
            for axes, values in (("xyz", tip.translation), ("xyzw", tip.quaternion))
        )
        pose = self.mount.pose_of({"position": position, "orientation": turn})
        return {"x_mm": pose.x_mm, "y_mm": pose.y_mm, "z_mm": pose.z_mm, "yaw_rad": pose.yaw_rad}

    def stop(self):
        """Stop now."""
        self.robot.stop()

    def recover(self):
        """Clear an error of the robot, such as a reflex at contact."""
        self.robot.recover_from_errors()


class FrankaHand:
    """The Franka Hand. Home it in Franka Desk before use: homing moves the jaws.

    The force of `franky` is the gripper's; we take half of it as the force on each finger. Measure it for your hand.

    Args:
        host: Address of the robot.
    """

    def __init__(self, host):
        self.hand, self.force_n = franky.Gripper(host), None

    def open(self, opening_mm, speed_mm_s):
        """Open or narrow the jaws."""
        self.force_n = None
        if not self.hand.move(opening_mm / 1000, speed_mm_s / 1000):
            raise RuntimeError(f"the jaws did not reach {opening_mm} mm; home the hand in Franka Desk")

    def grasp(self, force_n, speed_mm_s):
        """Close until each finger has the force, at any width."""
        self.force_n = force_n
        width = self.hand.max_width
        self.hand.grasp(0.0, speed_mm_s / 1000, 2 * force_n, epsilon_inner=width, epsilon_outer=width)

    def state(self):
        """Return opening, force on each finger and status."""
        opening_mm = 1000 * self.hand.width
        if self.force_n is None:
            status = "idle"
        elif opening_mm <= HELD_MM:
            status = "no_part"
        else:
            status = "holding" if self.hand.is_grasped else "part_lost"
        force_n = self.force_n if status == "holding" else 0.0
        return {"opening_mm": opening_mm, "force_n": force_n, "status": status}

    def stop(self):
        """Stop the jaws."""
        self.hand.stop()
