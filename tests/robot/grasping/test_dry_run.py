"""A dry run: the motions of an attempt are said, and nothing moves."""

import pytest

from robot.errors import DeviceError
from robot.grasping.attempt import AttemptRunner
from robot.grasping.dry_run import make_dry_run
from robot.grasping.settings import AttemptSettings
from robot.readings import Pose
from robot.sim.rig import SimRig
from tests.fake_rig import FakeRig


def test_the_motions_of_an_attempt_are_said_in_order_and_nothing_is_moved():
    said = []
    rig = FakeRig(5)
    world = rig.world
    with make_dry_run(rig, said.append) as dry:
        attempt = AttemptRunner(dry, 5, AttemptSettings()).run("round-0", 0)
    assert attempt.outcome == "held"
    assert {"arm", "grasp", "open", "arm.connect", "gripper.connect"}.isdisjoint(world.calls)
    assert "depth" in world.calls  # it looks, and feels
    assert "gel a" in world.calls
    starts = [" ".join(line.split()[:2]) for line in said]
    assert starts == [
        "jaws: open",  # wide
        "arm: to",  # out of the picture
        "arm: to",  # above the object
        "jaws: open",  # as wide as the object asks
        "arm: to",  # down
        "jaws: close",
        "arm: to",  # up
        "arm: to",  # over the place to put it
        "arm: to",  # down
        "jaws: open",
        "arm: to",  # up
    ]
    assert said[1] == "arm: to x 0.0, y 150.0, z 500.0 mm, yaw 0.000 rad, at 200 mm/s"


def test_a_tilt_is_said_and_is_refused_where_the_arm_keeps_the_hand_upright():
    said, pose = [], Pose(0.0, 0.0, 100.0, 0.0, 1.5708)
    with make_dry_run(SimRig(0), said.append) as dry:
        dry.arm.move_to(pose, 100.0)
    assert said == ["arm: to x 0.0, y 0.0, z 100.0 mm, yaw 0.000 rad, tilt 1.571 rad, at 100 mm/s"]
    with make_dry_run(FakeRig(5), print) as dry, pytest.raises(DeviceError, match="straight down: tilt must be 0"):
        dry.arm.move_to(pose, 100.0)


def test_what_the_rig_may_not_do_is_refused_in_a_dry_run_too():
    rig = FakeRig(5)
    limits = rig.arm.workspace, rig.gripper.max_force_n
    dry = make_dry_run(rig, print)
    assert (dry.arm.workspace, dry.gripper.max_force_n) == limits
