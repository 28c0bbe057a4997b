"""The manual arm: one request for each pose, and no assumed pose after an interruption."""

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
    requests = []
    arm = connected(requests.append)
    target = Pose(-12.4, 30.0, 120.0, math.radians(35))
    assert arm.move_to(target, 100.0) == target == arm.pose()
    (text,) = requests
    assert "120 mm above the table, 12 mm to the left of the origin, 30 mm behind it as the camera sees it" in text
    assert "from finger a to finger b 35 deg counter-clockwise" in text
    assert text.endswith("then press Enter.")


@pytest.mark.parametrize(
    ("change", "count"),
    [
        ((0.5, 0.5, 0.5, math.tau + math.radians(0.9)), 1),
        ((0.9, 0.9, 0.0, 0.0), 2),
        ((0.0, 0.0, 0.0, math.radians(-1.1)), 2),
    ],
)
def test_a_pose_within_a_millimetre_and_a_degree_is_not_requested_again(change, count):
    requests = []
    arm = connected(requests.append)
    first = Pose(0.0, 0.0, 100.0, 0.3)
    second = Pose(*(a + b for a, b in zip(first.as_tuple(), change, strict=True)))
    arm.move_to(first, 100.0)
    assert arm.move_to(second, 100.0) == (first if count == 1 else second)
    assert len(requests) == count


def test_the_pose_is_unknown_before_the_first_motion_after_a_stop_and_after_reconnecting():
    requests = []
    arm = connected(requests.append)
    with pytest.raises(DeviceError, match="call move_to first"):
        arm.pose()
    arm.move_to(Pose(0, 0, 100, 0), 100.0)
    arm.stop()
    with pytest.raises(DeviceError, match="call move_to first"):
        arm.pose()
    arm.move_to(Pose(0, 0, 100, 0), 100.0)
    assert len(requests) == 2
    arm.close()
    arm.connect()
    with pytest.raises(DeviceError, match="call move_to first"):
        arm.pose()


@pytest.mark.parametrize(("raised", "error"), [(KeyboardInterrupt, KeyboardInterrupt), (EOFError, RobotConfigError)])
def test_after_an_interrupted_prompt_or_without_a_terminal_the_pose_is_unknown(raised, error):
    def ask(_):
        raise raised

    arm = connected(ask)
    with pytest.raises(error):
        arm.move_to(Pose(0, 0, 100, 0), 100.0)
    with pytest.raises(DeviceError, match="call move_to first"):
        arm.pose()
