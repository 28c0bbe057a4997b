"""Dry run of a rig: its own sensors and camera, with an arm and a gripper that report motions instead of moving."""

from collections.abc import Callable

from robot.devices import Arm, Gripper, VirtualDevice
from robot.readings import GripperState, Pose
from robot.rig import Rig

Report = Callable[[str], object]


def make_dry_run(rig: Rig, report: Report) -> Rig:
    """Replace the arm and the gripper of an unconnected rig by ones that `report` each motion; return the rig.

    The limits of the rig's file are checked. Typical values replace the limits that a gripper reports when it connects,
    so the rig may still refuse a motion of a dry run.
    """
    rig.arm = DryRunArm(rig.arm, report)
    rig.gripper = DryRunGripper(rig.gripper, report)
    return rig


class DryRunArm(VirtualDevice, Arm):
    """An arm that reports each motion and reaches its goal immediately."""

    def __init__(self, arm: Arm, report: Report) -> None:
        super().__init__(f"{arm.name} (dry run)", arm.workspace, max_speed_mm_s=arm.max_speed_mm_s, clock=arm.clock)
        self.can_tilt = arm.can_tilt
        self._report = report
        lower, upper = arm.workspace.lower, arm.workspace.upper
        self._at = Pose((lower[0] + upper[0]) / 2, (lower[1] + upper[1]) / 2, upper[2], 0.0)

    def _move_to(self, pose: Pose, speed_mm_s: float) -> Pose:
        tilt = f"tilt {pose.tilt_rad:.3f} rad, " if pose.tilt_rad else ""
        self._report(
            f"arm: to x {pose.x_mm:.1f}, y {pose.y_mm:.1f}, z {pose.z_mm:.1f} mm, yaw {pose.yaw_rad:.3f} rad, "
            f"{tilt}at {speed_mm_s:g} mm/s"
        )
        self._at = pose
        return pose

    def _pose(self) -> Pose:
        return self._at


class DryRunGripper(VirtualDevice, Gripper):
    """A gripper that reports each motion; every grasp holds an object."""

    def __init__(self, gripper: Gripper, report: Report) -> None:
        super().__init__(
            f"{gripper.name} (dry run)",
            stroke_mm=gripper.stroke_mm,
            min_force_n=gripper.min_force_n,
            max_force_n=gripper.max_force_n,
            max_speed_mm_s=gripper.max_speed_mm_s,
            clock=gripper.clock,
        )
        self._report = report
        self._now = GripperState(gripper.stroke_mm, 0.0, "idle")

    def _state(self) -> GripperState:
        return self._now

    def _open(self, opening_mm: float) -> GripperState:
        self._report(f"jaws: open to {opening_mm:.1f} mm")
        self._now = GripperState(opening_mm, 0.0, "idle")
        return self._now

    def _grasp(self, force_n: float, speed_mm_s: float) -> GripperState:
        self._report(f"jaws: close with {force_n:.1f} N at {speed_mm_s:g} mm/s")
        self._now = GripperState(self._now.opening_mm, force_n, "holding")
        return self._now
