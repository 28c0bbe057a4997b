"""A dry run reports the motions of an attempt and moves nothing."""

import pytest

from robot.errors import DeviceError
from robot.grasping.attempt import AttemptRunner
from robot.grasping.dry_run import make_dry_run
from robot.grasping.settings import AttemptSettings
from robot.readings import Pose
from robot.sim.rig import SimRig
from tests.fake_rig import FakeRig


def test_the_motions_of_an_attempt_are_reported_in_order_and_nothing_is_moved():
    reports, rig = [], FakeRig(5)
    with make_dry_run(rig, reports.append) as dry:
        attempt = AttemptRunner(dry, 5, AttemptSettings()).run("round-0", 0)
    assert attempt.outcome == "held"
    assert {"arm", "grasp", "open", "arm.connect", "gripper.connect"}.isdisjoint(rig.shared.calls)
    assert {"depth", "gel a"} <= set(rig.shared.calls)  # camera and gels are read
    # Out of the picture, above the object, down and up; then over the place where it is put down, down and up.
    motions = ["open", "to", "to", "open", "to", "close", "to", "to", "to", "open", "to"]
    assert [line.split()[1] for line in reports] == motions
    assert reports[1] == "arm: to x 0.0, y 150.0, z 500.0 mm, yaw 0.000 rad, at 200 mm/s"


def test_a_tilt_is_reported_and_is_refused_for_an_arm_that_cannot_tilt():
    reports, pose = [], Pose(0.0, 0.0, 100.0, 0.0, 1.5708)
    with make_dry_run(SimRig(0), reports.append) as dry:
        dry.arm.move_to(pose, 100.0)
    assert reports == ["arm: to x 0.0, y 0.0, z 100.0 mm, yaw 0.000 rad, tilt 1.571 rad, at 100 mm/s"]
    with make_dry_run(FakeRig(5), print) as dry, pytest.raises(DeviceError, match="tilt must be 0"):
        dry.arm.move_to(pose, 100.0)
