"""The arm that is a person: asked once for each pose, in words, and never believed after an interruption."""

import math

import pytest

from robot.drivers.manual_arm import ManualArm
from robot.errors import DeviceError, RobotConfigError
from robot.readings import Pose, Region

WORKSPACE = Region((-150.0, -150.0, 0.0), (150.0, 150.0, 400.0))


def connected(ask):
    arm = ManualArm(workspace=WORKSPACE, ask=ask)
    arm.connect()
    return arm


def test_a_pose_is_requested_in_words_and_assumed_reached():
    asked = []
    arm = connected(asked.append)
    target = Pose(-12.4, 30.0, 120.0, math.radians(35))
    assert arm.move_to(target, 100.0) == target == arm.pose()
    (words,) = asked
    assert (
        "120 mm above the table, 12 mm to the left of the middle of the workspace, 30 mm away from the camera" in words
    )
    assert "turned by 35 deg" in words
    assert words.endswith("then press Enter.")


@pytest.mark.parametrize(
    ("change", "asks"),
    [
        ((0.5, 0.5, 0.5, 0.0), 1),
        ((0.0, 0.0, 1.1, 0.0), 2),
        ((0.9, 0.9, 0.0, 0.0), 2),
        ((0.0, 0.0, 0.0, math.radians(0.9)), 1),
        ((0.0, 0.0, 0.0, math.radians(-1.1)), 2),
        ((0.0, 0.0, 0.0, math.tau), 1),
        ((0.0, 0.0, 0.0, math.pi), 2),
    ],
)
def test_a_pose_within_a_millimetre_and_a_degree_is_not_asked_again(change, asks):
    asked = []
    arm = connected(asked.append)
    first = Pose(0.0, 0.0, 100.0, 0.3)
    second = Pose(*(a + b for a, b in zip(first.as_tuple(), change, strict=True)))
    arm.move_to(first, 100.0)
    assert arm.move_to(second, 100.0) == (first if asks == 1 else second)
    assert len(asked) == asks


def test_small_steps_do_not_add_up_unasked():
    asked = []
    arm = connected(asked.append)
    for number in range(11):
        arm.move_to(Pose(0.3 * number, 0.0, 100.0, 0.0), 100.0)
    assert len(asked) == 3  # at 0, 1.2 and 2.4 mm


def test_where_the_hand_is_nobody_knows_before_the_first_pose_after_a_stop_or_when_connected_again():
    asked = []
    arm = connected(asked.append)
    with pytest.raises(DeviceError, match="call move_to first"):
        arm.pose()
    arm.move_to(Pose(0, 0, 100, 0), 100.0)
    arm.stop()
    with pytest.raises(DeviceError, match="call move_to first"):
        arm.pose()
    arm.move_to(Pose(0, 0, 100, 0), 100.0)
    assert len(asked) == 2
    arm.close()
    arm.connect()
    with pytest.raises(DeviceError, match="call move_to first"):
        arm.pose()


def test_a_person_who_interrupts_is_asked_again():
    def interrupt(_):
        raise KeyboardInterrupt

    arm = connected(interrupt)
    with pytest.raises(KeyboardInterrupt):
        arm.move_to(Pose(0, 0, 100, 0), 100.0)
    with pytest.raises(DeviceError, match="call move_to first"):
        arm.pose()


def test_nobody_there_is_said_so():
    def ended(_):
        raise EOFError

    with pytest.raises(RobotConfigError, match="run it in a terminal"):
        connected(ended).move_to(Pose(0, 0, 100, 0), 100.0)


def test_the_limits_hold_for_a_person_too():
    arm = ManualArm(workspace=WORKSPACE, max_speed_mm_s=50.0, ask=lambda _: None)
    with pytest.raises(DeviceError, match="must be connected"):
        arm.move_to(Pose(0, 0, 100, 0), 10.0)
    arm.connect()
    with pytest.raises(DeviceError, match="workspace"):
        arm.move_to(Pose(0, 0, 500, 0), 10.0)
    with pytest.raises(DeviceError, match="speed"):
        arm.move_to(Pose(0, 0, 100, 0), 60.0)
