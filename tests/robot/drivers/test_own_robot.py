"""Arms and grippers of a user's own program."""

import numpy as np
import pytest

from robot.drivers.own_robot import OwnArm, OwnGripper
from robot.errors import DeviceError, RobotConfigError, UnknownName
from robot.readings import Pose, Region
from robot.real_rig import load_driver
from tests import plugins

WORKSPACE = Region((-100.0, -100.0, 10.0), (100.0, 100.0, 300.0))
GOAL = Pose(10.0, 20.0, 30.0, 0.5)
HERE = f"{__name__}:"


class Program:
    """A robot program with all methods of arm and gripper; it records its calls."""

    last: "Program"

    def __init__(self, lag_mm=0.0, fault=None):
        self.at = {"x_mm": 0.0, "y_mm": 0.0, "z_mm": 100.0, "yaw_rad": 0.0}
        self.jaws = {"opening_mm": 80.0, "force_n": 0.0, "status": "idle"}
        self.lag_mm, self.fault, self.calls = lag_mm, fault, []
        Program.last = self

    def move_to(self, *, speed_mm_s, **pose):
        self.calls.append(("move_to", speed_mm_s))
        if self.fault:
            raise self.fault
        self.at = {**pose, "x_mm": np.float64(pose["x_mm"] - self.lag_mm)}

    def pose(self):
        return self.at

    def open(self, opening_mm, speed_mm_s):
        self.calls.append(("open", speed_mm_s))
        self.jaws = {"opening_mm": opening_mm, "force_n": 0.0, "status": "idle"}

    def grasp(self, force_n, speed_mm_s):
        self.calls.append(("grasp", force_n, speed_mm_s))
        self.jaws = {"opening_mm": 40.0, "force_n": force_n, "status": "holding"}

    def state(self):
        return self.jaws

    def stop(self):
        self.calls.append("stop")

    def disconnect(self):
        self.calls.append("disconnect")


class Incomplete:
    def pose(self): ...


def python_arm(**settings):
    return OwnArm(workspace=WORKSPACE, robot=f"{HERE}Program", settings=settings, max_speed_mm_s=200.0)


def test_a_gripper_opens_at_the_speed_limit_and_grasps_with_the_requested_force():
    limits = {"stroke_mm": 80.0, "min_force_n": 5.0, "max_force_n": 20.0, "max_speed_mm_s": 60.0}
    with OwnGripper(robot=f"{HERE}Program", **limits) as gripper:
        assert gripper.open(70.0).opening_mm == 70.0
        state = gripper.grasp(15.0, 40.0)
        assert (state.status, state.force_n) == ("holding", 15.0)
        assert Program.last.calls == [("open", 60.0), ("grasp", 15.0, 40.0)]


def test_an_arm_that_does_not_arrive_is_stopped_and_the_message_says_how_far_it_is():
    with python_arm(lag_mm=12.0) as arm:
        with pytest.raises(DeviceError, match=r"within 5 mm and 5 deg of its goal .* it is 12\.0 mm and 0\.0 deg away"):
            arm.move_to(GOAL, 50.0)
        assert Program.last.calls[-1] == "stop"


@pytest.mark.parametrize("fault", [RuntimeError("it broke"), OSError("it broke"), KeyboardInterrupt("it broke")])
def test_an_exception_of_the_program_stops_the_arm_and_is_a_device_error_unless_it_is_ctrl_c(fault):
    error = DeviceError if isinstance(fault, Exception) else KeyboardInterrupt
    with python_arm(fault=fault) as arm:
        with pytest.raises(error, match="it broke"):
            arm.move_to(GOAL, 50.0)
        assert Program.last.calls[-1] == "stop"


def test_closing_calls_disconnect_once():
    arm = python_arm()
    arm.connect()
    arm.close()
    arm.close()
    assert Program.last.calls == ["disconnect"]


def test_a_program_that_does_not_fit_is_refused_with_the_reason():
    with pytest.raises(UnknownName, match=r"nowhere:Arm.* PYTHONPATH"):
        OwnArm(workspace=WORKSPACE, robot="nowhere:Arm")
    with pytest.raises(DeviceError, match="it lacks move_to, stop"):
        OwnArm(workspace=WORKSPACE, robot=f"{HERE}Incomplete").connect()
    with pytest.raises(DeviceError, match=r"cannot be made: .*'wheels'"):
        python_arm(wheels=4).connect()
    with python_arm() as arm:
        Program.last.at = {"x_mm": 1.0}
        with pytest.raises(DeviceError, match=r"pose of .*y_mm"):
            arm.pose()
    with pytest.raises(RobotConfigError, match="min_force_n must be at most max_force_n"):
        OwnGripper(stroke_mm=80.0, min_force_n=30.0, max_force_n=20.0, robot=f"{HERE}Program")


def test_a_rig_file_builds_it_and_a_package_adds_a_robot_by_an_entry_point(tmp_path, monkeypatch):
    plugins.install(tmp_path / "site", monkeypatch, robots={"mine": f"{HERE}Program"})
    table = {"driver": "own", "robot": "mine", "settings": {"lag_mm": 1.0}}
    with load_driver("arm", table, "[arm]", workspace=WORKSPACE, max_speed_mm_s=100.0, max_state_age_s=0.5) as arm:
        assert arm.max_speed_mm_s == 100.0
        assert Program.last.lag_mm == 1.0
