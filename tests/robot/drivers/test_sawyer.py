"""The Sawyer driver with the emulated robot on a real websocket: targets, speeds and stops."""

import contextlib
import logging
import math
import os
import signal
import threading
import time

import numpy as np
import pytest

from robot.drivers.sawyer import codec as messages
from robot.drivers.sawyer.codec import JOINTS, JointTrajectory, Mount, waypoints
from robot.drivers.sawyer.driver import Sawyer
from robot.errors import DeviceError
from robot.readings import Pose, Region
from tests.emulators.sawyer.arm import READY, SawyerModel, forward, inverse
from tests.emulators.sawyer.server import LIMB, EmulatedSawyer, serve
from tests.waiting import wait_until

WORKSPACE = Region((-150.0, -150.0, 0.0), (150.0, 150.0, 300.0))
MOUNT = {"base_xyz_mm": [500.0, 0.0, -100.0], "base_yaw_deg": 180.0, "tool_mm": 150.0}
HOME = Pose(0.0, 0.0, 60.0, 0.0)
FAR = Pose(0.0, 0.0, 260.0, 0.0)


def arm_at(url, **changes):
    port = int(url.rpartition(":")[2])
    arguments = {"workspace": WORKSPACE, "host": "127.0.0.1", "port": port, **MOUNT, "timeout_s": 5.0, **changes}
    return Sawyer(**arguments)


@contextlib.contextmanager
def connected(emulator=None, **changes):
    """Yield an emulator and a connected arm; states may be a second old by default, because machines are slow."""
    emulator = emulator or EmulatedSawyer()
    with serve(emulator) as url, arm_at(url, **{"max_state_age_s": 1.0, **changes}) as arm:
        yield emulator, arm


@contextlib.contextmanager
def while_it_moves(emulator, act):
    """Call `act` after 15 more commands."""
    before = len(emulator.commands)

    def run():
        wait_until(lambda: len(emulator.commands) > before + 15)
        act()

    thread = threading.Thread(target=run)
    thread.start()
    yield
    thread.join()


def is_still(emulator):
    """Return whether the emulated arm is still."""
    return bool(np.abs(emulator.model.velocity).max() < 1e-3)


def offset(pose, other):
    turn = math.remainder(pose.yaw_rad - other.yaw_rad, math.tau)
    return math.dist(pose.as_tuple()[:3], other.as_tuple()[:3]), abs(turn)


# without a robot


def test_the_tip_of_a_pose():
    """The rig is 500 mm in front of the robot, rotated by 90 deg; the tip is 150 mm above the fingertips."""
    mount = Mount((500.0, 0.0, -100.0), math.pi / 2, 150.0, 0.0)
    tip = mount.tip_of(Pose(10.0, 20.0, 30.0, 0.0))
    assert tip["position"] == pytest.approx({"x": 0.480, "y": 0.010, "z": 0.080})
    root = math.sqrt(0.5)
    assert tip["orientation"] == pytest.approx({"x": root, "y": root, "z": 0.0, "w": 0.0})


def test_pose_of_is_the_inverse_of_tip_of():
    for yaw, base_yaw, tool_yaw in np.random.default_rng(0).uniform(-3.1, 3.1, (20, 3)).tolist():
        mount, pose = Mount((300.0, -200.0, 50.0), base_yaw, 120.0, tool_yaw), Pose(-70.0, 400.0, 5.0, yaw)
        assert offset(mount.pose_of(mount.tip_of(pose)), pose) == pytest.approx((0, 0), abs=1e-9)


def test_a_tilted_hand_is_refused():
    half = math.radians(180 - 11) / 2
    tip = {
        "position": {"x": 0.5, "y": 0.0, "z": 0.1},
        "orientation": {"x": math.sin(half), "y": 0.0, "z": 0.0, "w": math.cos(half)},
    }
    with pytest.raises(DeviceError, match="point straight down, but is tilted by 11 deg"):
        Mount((0, 0, 0), 0.0, 0.0, 0.0).pose_of(tip)


def test_way_points_lie_on_the_line_and_turn_the_shorter_way():
    points = waypoints(Pose(0, 0, 0, 3.0), Pose(30, 40, 0, -3.0))
    assert points[0] == Pose(0, 0, 0, 3.0)
    assert points[-1] == Pose(30, 40, 0, -3.0)
    assert len(points) == 6  # 50 mm in steps of 10
    assert [point.x_mm for point in points] == pytest.approx([0, 6, 12, 18, 24, 30])
    assert points[2].yaw_rad == pytest.approx(3.0 + 0.4 * (math.tau - 6.0))
    assert len(waypoints(HOME, HOME)) == 2


def planned(goal):
    poses = waypoints(HOME, goal)
    mount, joints = Mount((500.0, 0.0, -100.0), math.pi, 150.0, 0.0), [READY]
    for pose in poses:
        tip = mount.tip_of(pose)
        place, turn = [tip["position"][axis] for axis in "xyz"], [tip["orientation"][axis] for axis in "xyzw"]
        joints.append(inverse(place, turn, joints[-1]))
    return JointTrajectory.from_waypoints(poses, np.array(joints[1:]), 100.0, 10.0)


@pytest.mark.parametrize("goal", [FAR, Pose(140, -140, 20, 1.0), Pose(-140, 140, 290, -1.0), Pose(0, 0, 62, 0)])
def test_the_hand_stays_on_the_line_and_within_the_requested_speed(goal):
    schedule = planned(goal)
    moments = np.linspace(0, schedule.duration_s, 1000)
    places = np.array([forward(schedule.at(moment))[0] for moment in moments]) * 1000
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / (moments[1] - moments[0])
    assert speeds.max() < 101.0
    line = places[-1] - places[0]
    along = np.outer((places - places[0]) @ line / (line @ line), line)
    assert np.linalg.norm(places - places[0] - along, axis=1).max() < 0.1
    assert math.dist(places[0], places[-1]) == pytest.approx(math.dist(HOME.as_tuple()[:3], goal.as_tuple()[:3]))


def test_joints_are_read_by_name_and_other_joints_are_ignored():
    names = ["head_pan", *reversed(JOINTS)]
    found = messages.joints_of({"name": names, "position": [9.0, *range(7)]})
    assert found.tolist() == [6, 5, 4, 3, 2, 1, 0]
    assert messages.joints_of({"name": ["finger"], "position": [0.1]}) is None
    with pytest.raises(DeviceError, match="position"):
        messages.joints_of({"name": list(JOINTS), "position": [None, 0, 0, 0, 0, 0, 0]})


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"stopped": True, "estop_button": 3, "estop_source": 1}, "released, but the stop is still active"),
        ({"error": True}, "error of one of its parts"),
        ({"enabled": False}, "is not enabled"),
    ],
)
def test_the_blocking_reason_names_the_action_for_a_person(fields, text):
    message = {"enabled": True, "stopped": False, "error": False, "estop_button": 0, "estop_source": 0}
    assert messages.parse(message, messages.RobotState).blocking_reason is None
    assert text in messages.parse(message | fields, messages.RobotState).blocking_reason


# with the emulated robot


def test_it_reaches_its_target_by_the_robots_own_measurement():
    with connected() as (emulator, arm):
        target = Pose(20.0, -30.0, 90.0, 0.2)
        assert offset(arm.move_to(target, 200.0), target) < (1.0, 0.02)
        x, y, z = forward(emulator.model.joints)[0]
        assert (x, y, z) == pytest.approx((0.480, 0.030, 0.140), abs=1e-3)  # base turned by 180 deg: 500 - 20, 30
        assert offset(arm.pose(), target) < (1.0, 0.02)
        assert offset(arm.move_to(arm.pose(), 200.0), target) < (1.0, 0.02)  # without a way


def test_a_command_step_is_at_most_two_ticks_at_full_speed_also_after_a_pause():
    with connected() as (emulator, arm):
        arm.move_to(HOME, 200.0)
        emulator.commands.clear()
        command, pauses = arm._command, []

        def paused(joints):
            command(joints)
            if len(emulator.commands) > 10 and not pauses:
                pauses.append(time.sleep(0.15))

        arm._command = paused
        arm.move_to(Pose(0.0, 0.0, 110.0, 0.0), 100.0)
        places = np.array([forward(joints)[0] for joints in emulator.commands]) * 1000
        assert len(pauses) == 1
        assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 100.0 * 0.02 * 1.01


def test_the_robot_gets_the_speed_ratio():
    with connected(speed_ratio=0.2) as (emulator, arm):
        wait_until(lambda: emulator.model.speed_ratio == 0.2)
        assert arm.settings()["speed_ratio"] == 0.2


def test_an_emergency_stop_ends_the_motion_and_the_driver_never_resets_it():
    with connected() as (emulator, arm):
        with while_it_moves(emulator, emulator.press_estop), pytest.raises(DeviceError) as caught:
            arm.move_to(FAR, 50.0)
        assert "stopped by the red button" in str(caught.value)
        assert "turn the button" in str(caught.value)
        for use in (arm.recover, lambda: arm.move_to(FAR, 50.0)):
            with pytest.raises(DeviceError, match="never resets an emergency stop"):
                use()
        assert emulator.model.stopped
        assert offset(arm.pose(), FAR)[0] > 50
        emulator.release_estop()
        wait_until(lambda: arm._robot_state().blocking_reason is None)
        arm.recover()
        target = Pose(0, 0, arm.pose().z_mm + 5, 0)
        assert offset(arm.move_to(target, 100.0), target)[0] < 1


def test_a_momentary_collision_report_stops_the_arm():
    def bump():
        emulator.model.has_collided = True
        published = len(arm._link.history(LIMB + "collision_detection_state"))
        history = lambda: arm._link.history(LIMB + "collision_detection_state")  # noqa: E731
        wait_until(lambda: arm._has_collided_since(0.0) or len(history()) > published + 99)
        emulator.model.has_collided = False

    with connected() as (emulator, arm):
        with while_it_moves(emulator, bump), pytest.raises(DeviceError, match="reports a collision and the arm holds"):
            arm.move_to(FAR, 50.0)
        held = np.array(emulator.commands[-1])
        assert np.abs(emulator.model.joints - held).max() < 0.02
        assert offset(arm.pose(), FAR)[0] > 50
        arm.recover()
        target = Pose(0, 0, arm.pose().z_mm + 5, 0)
        assert offset(arm.move_to(target, 100.0), target)[0] < 1


def test_a_lasting_collision_requires_a_person():
    with connected() as (emulator, arm):
        emulator.model.has_collided = True
        wait_until(lambda: arm._has_collided_since(0.0))
        with pytest.raises(DeviceError, match="recovery is refused: the robot reports a collision"):
            arm.recover()
        with pytest.raises(DeviceError, match="reports a collision"):
            arm.move_to(FAR, 50.0)
        assert offset(arm.pose(), FAR)[0] > 100


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("/robot/joint_states", "joint state must be at most"),
        ("/robot/state", "an emergency stop would not be detected"),
        (LIMB + "collision_detection_state", "a collision would not be detected"),
    ],
)
def test_a_motion_ends_if_a_topic_falls_silent(topic, message, monkeypatch):
    monkeypatch.setattr("robot.drivers.sawyer.driver._SLOW_STATE_AGE_S", 0.5)
    with connected(max_state_age_s=0.5) as (emulator, arm):
        with while_it_moves(emulator, lambda: emulator.silent.add(topic)), pytest.raises(DeviceError, match=message):
            arm.move_to(FAR, 20.0)
        count = len(emulator.commands)
        wait_until(lambda: is_still(emulator))  # the robot's own time-out
        assert len(emulator.commands) == count
        assert offset(FAR, Pose(0, 0, 1000 * forward(emulator.model.joints)[0][2] - 50, 0))[0] > 50
        emulator.silent.clear()
        arm.recover()
        assert offset(arm.pose(), FAR)[0] > 50


def test_a_broken_connection_stops_the_arm_and_recovery_connects_again(caplog):
    with connected() as (emulator, arm):
        with while_it_moves(emulator, emulator.drop_connections), pytest.raises(DeviceError, match="closed") as caught:
            arm.move_to(FAR, 50.0)
        assert "and while sawyer was stopped" in caught.value.__notes__[0]
        with pytest.raises(DeviceError, match="is closed"):
            arm.stop()
        wait_until(lambda: is_still(emulator))
        with caplog.at_level(logging.WARNING):
            arm.recover()
        assert "connecting again" in caplog.text
        target = Pose(0, 0, arm.pose().z_mm + 5, 0)
        assert offset(arm.move_to(target, 100.0), target)[0] < 1


def test_the_tries_to_reconnect_are_limited(monkeypatch, caplog):
    monkeypatch.setattr("robot.drivers.sawyer.driver._RECONNECT_S", (0.0,) * 3)
    with contextlib.ExitStack() as robot:
        arm = arm_at(robot.enter_context(serve(EmulatedSawyer())), timeout_s=5.0)
        arm.connect()
        robot.close()
        wait_until(lambda: arm._link._closed_reason)
        with caplog.at_level(logging.WARNING), pytest.raises(DeviceError, match="rosbridge must answer at"):
            arm.recover()
        assert caplog.text.count("connecting again") == 3
        with pytest.raises(DeviceError):
            arm.pose()
        arm.close()


def test_ctrl_c_leaves_the_arm_still():
    with connected() as (emulator, arm):
        with while_it_moves(emulator, lambda: os.kill(os.getpid(), signal.SIGINT)), pytest.raises(KeyboardInterrupt):
            arm.move_to(FAR, 20.0)
        assert is_still(emulator)
        assert np.abs(emulator.model.joints - emulator.commands[-1]).max() < 0.02


def test_inverse_kinematics_is_retried_with_other_seeds_a_limited_number_of_times():
    with connected() as (emulator, arm):
        emulator.refuse_ik = 2
        arm.move_to(HOME, 200.0)
        emulator.refuse_ik, emulator.calls = 1000, 0
        before = emulator.model.joints
        with pytest.raises(DeviceError, match=r"after 3 tries: .*no joint angles reach it; the arm has not moved"):
            arm.move_to(FAR, 200.0)
        assert emulator.calls == 3
        assert np.abs(emulator.model.joints - before).max() < 2e-3


def test_solutions_with_large_joint_steps_are_refused_before_any_motion(monkeypatch):
    with connected() as (emulator, arm):
        leap = np.array([1.0, 0, 0, 0, 0, 0, 0])
        answer = messages.ik_answer
        monkeypatch.setattr(messages, "ik_answer", lambda values: answer(values) + leap)
        with pytest.raises(DeviceError, match=r"turns a joint by 1\.0"):
            arm.move_to(FAR, 100.0)
        assert offset(arm.pose(), FAR)[0] > 100
        assert is_still(emulator)


def test_an_arm_outside_the_workspace_is_not_moved():
    """It is moved within 20 mm of the workspace, as after a stop."""
    with connected(base_xyz_mm=[500.0, 0.0, -20.0]) as (emulator, arm):
        with pytest.raises(DeviceError, match=r"must be in the workspace .*first, but is at .* bring it there by hand"):
            arm.move_to(Pose(0.0, 0.0, 30.0, 0.0), 100.0)
        assert is_still(emulator)
    with connected(base_xyz_mm=[500.0, 0.0, -60.0]) as (_, arm):
        assert arm.pose().z_mm == pytest.approx(-10.0, abs=0.5)
        arm.move_to(Pose(0.0, 0.0, 5.0, 0.0), 100.0)


def test_a_blocked_arm_ends_the_motion(monkeypatch):
    class Held(SawyerModel):
        def command(self, target):
            pass

    with connected(EmulatedSawyer(model=Held())) as (_, arm), pytest.raises(DeviceError, match="must follow within"):
        arm.move_to(Pose(0.0, 0.0, 250.0, 1.5), 200.0)
    monkeypatch.setattr("robot.drivers.sawyer.driver._SETTLE_S", 0.1)
    with connected(EmulatedSawyer(model=Held())) as (_, arm), pytest.raises(DeviceError, match="is the arm blocked"):
        arm.move_to(Pose(0.0, 0.0, 45.0, 0.0), 200.0)


def test_motors_are_enabled_only_if_allowed_and_a_robot_that_may_not_move_is_not_connected(caplog):
    def emulated(prepare):
        emulator = EmulatedSawyer()
        prepare(emulator)
        return emulator

    def disable(emulator):
        emulator.model.enabled = False

    for prepare, enable in ((EmulatedSawyer.press_estop, True), (disable, False)):
        with serve(emulated(prepare)) as url:
            arm = arm_at(url, enable=enable)
            with pytest.raises(DeviceError, match="by hand"):
                arm.connect()
            assert not arm.is_connected
            assert arm._link._closed_reason
    with caplog.at_level(logging.WARNING), connected(emulated(disable), enable=True) as (emulator, _):
        assert emulator.model.enabled
        assert "enabling the motors" in caplog.text


def test_a_silent_topic_and_an_unknown_tip_are_named():
    emulator = EmulatedSawyer()
    emulator.silent.add(LIMB + "tip_states")
    with serve(emulator) as url, pytest.raises(DeviceError, match="no message on /robot/limb/right/tip_states"):
        arm_at(url, timeout_s=0.2).connect()
    with connected(tip="left_hand") as (_, arm), pytest.raises(DeviceError, match="must report its tip 'left_hand'"):
        arm.pose()
