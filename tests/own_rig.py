"""The fake rig, moved by programs of a user: `driver = "own"` with Python objects."""

import dataclasses

from robot.drivers.own_robot import OwnArm, OwnGripper
from robot.readings import Pose
from tests.fake_rig import FORCE_N, STROKE_MM, WORKSPACE, FakeArm, FakeGripper, FakeRig


class ArmProgram:
    def __init__(self, shared):
        self.arm = FakeArm(shared)

    def move_to(self, x_mm, y_mm, z_mm, yaw_rad, speed_mm_s):
        self.arm._move_to(Pose(x_mm, y_mm, z_mm, yaw_rad), speed_mm_s)

    def pose(self):
        x_mm, y_mm, z_mm, yaw_rad = self.arm._pose().as_tuple()
        return {"x_mm": x_mm, "y_mm": y_mm, "z_mm": z_mm, "yaw_rad": yaw_rad}

    def stop(self):
        self.arm._stop()


class GripperProgram:
    def __init__(self, shared):
        self.gripper = FakeGripper(shared)

    def open(self, opening_mm, speed_mm_s):
        self.gripper._open(opening_mm)

    def grasp(self, force_n, speed_mm_s):
        self.gripper._grasp(force_n, speed_mm_s)

    def state(self):
        return dataclasses.asdict(self.gripper._state())

    def stop(self):
        self.gripper._stop()


def own_rig(seed):
    """Return a fake rig whose arm and gripper are moved by the programs above."""
    rig = FakeRig(seed)
    settings, (low, high) = {"shared": rig.shared}, FORCE_N
    common = {"settings": settings, "clock": rig.clock}
    rig.arm = OwnArm(workspace=WORKSPACE, robot="tests.own_rig:ArmProgram", **common)
    rig.gripper = OwnGripper(
        stroke_mm=STROKE_MM, min_force_n=low, max_force_n=high, robot="tests.own_rig:GripperProgram", **common
    )
    return rig
