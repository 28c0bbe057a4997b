"""The examples of integrations/robots against stubs of the documented interfaces of their vendors."""

import json
import math
import socketserver
import sys
import threading
import types
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from robot.devices import Arm
from robot.errors import DeviceError
from robot.readings import Pose, Region
from robot.real_rig import load_driver

FOLDER = Path(__file__).parents[2] / "integrations" / "robots"
WORKSPACE = Region((-150.0, -150.0, 10.0), (150.0, 150.0, 400.0))
ORIGIN = {"origin_mm": [500.0, 100.0, -20.0], "tool_mm": 120.0}


def load_arm(driver, **settings):
    """The arm that a rig's file names."""
    table = {"driver": driver, **settings}
    return load_driver("arm", table, "[arm]", workspace=WORKSPACE, max_speed_mm_s=200.0, max_state_age_s=0.5)


def load_gripper(driver, **settings):
    """The gripper that a rig's file names."""
    table = {"driver": driver, **settings}
    return load_driver("gripper", table, "[gripper]", max_speed_mm_s=90.0, max_force_n=40.0, max_state_age_s=0.5)


@pytest.fixture(autouse=True)
def examples(monkeypatch):
    """The examples can be imported; vendor modules and examples are forgotten afterwards."""
    monkeypatch.syspath_prepend(str(FOLDER))
    yield
    for name in ("ur_arm", "franka", "robotiq_2f85", "remote"):
        sys.modules.pop(name, None)


class FakeUR:
    """The parts of rtde_control and rtde_receive that the example uses; a motion takes three polls."""

    def __init__(self):
        self.pose, self.goal, self.polls, self.finished = [0.5, 0.1, 0.4, math.pi, 0.0, 0.0], None, 0, -1
        self.calls, self.is_stopped = [], False
        self.isPoseWithinSafetyLimits = lambda target: True
        self.isProtectiveStopped, self.isEmergencyStopped = lambda: self.is_stopped, lambda: False
        self.getActualTCPPose = lambda: self.pose
        self.stopL, self.stopScript = lambda _: self.calls.append("stopL"), lambda: self.calls.append("stopScript")

    def moveL(self, target, speed, acceleration, asynchronous):
        self.calls.append(("moveL", speed))
        self.goal, self.polls = target, 3
        return True

    def getAsyncOperationProgress(self):
        """-1 or -2 if no operation runs, in turn; the motion begins one poll late, as on a robot."""
        if self.goal is None:
            return self.finished
        self.polls -= 1
        if self.polls == 2:
            return self.finished
        if self.polls:
            return 0
        self.pose, self.goal, self.finished = self.goal, None, -3 - self.finished
        return self.finished

    def disconnect(self): ...


@pytest.fixture
def ur(monkeypatch):
    fake = FakeUR()
    for module, name in (("rtde_control", "RTDEControlInterface"), ("rtde_receive", "RTDEReceiveInterface")):
        monkeypatch.setitem(sys.modules, module, types.SimpleNamespace(**{name: lambda host: fake}))
    with load_arm("ur_arm:URArm", host="ur", **ORIGIN) as arm:
        yield fake, arm
    assert fake.calls[-1] == "stopScript"


class FakeFranka:
    """The parts of franky that the example uses."""

    def __init__(self):
        self.tip = types.SimpleNamespace(translation=[0.5, 0.1, 0.4], quaternion=[1.0, 0.0, 0.0, 0.0])
        self.calls, self.relative_dynamics_factor, self.joins = [], None, 0
        self.translation_velocity_limit = types.SimpleNamespace(set=lambda speed: self.calls.append(("speed", speed)))
        self.stop, self.recover_from_errors = (partial(self.calls.append, call) for call in ("stop", "recover"))

    @property
    def current_cartesian_state(self):
        return types.SimpleNamespace(pose=types.SimpleNamespace(end_effector_pose=self.tip))

    def move(self, motion, asynchronous):
        self.calls.append("move")
        self.tip, self.joins = motion, 2

    def join_motion(self, timeout):
        self.joins -= 1
        return self.joins <= 0


class FakeHand:
    max_width = 0.08

    def __init__(self):
        self.width, self.is_grasped, self.object_m, self.calls = 0.08, False, 0.03, []
        self.stop = partial(self.calls.append, "stop")

    def move(self, width, speed):
        self.width, self.is_grasped = width, False
        return True

    def grasp(self, width, speed, force, epsilon_inner, epsilon_outer):
        self.calls.append(("grasp", speed, force))
        self.width, self.is_grasped = self.object_m, self.object_m > 0


@pytest.fixture
def franka(monkeypatch):
    robot, hand = FakeFranka(), FakeHand()
    module = types.SimpleNamespace(
        Robot=lambda host: robot,
        Gripper=lambda host: hand,
        RelativeDynamicsFactor=lambda *factors: factors,
        Affine=lambda translation, quaternion: types.SimpleNamespace(translation=translation, quaternion=quaternion),
        CartesianMotion=lambda goal: goal,
    )
    monkeypatch.setitem(sys.modules, "franky", module)
    return robot, hand


@contextmanager
def serving(kind, handler):
    """Answer on a free port in a thread."""
    with kind(("127.0.0.1", 0), handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join(10)


class URCap(socketserver.StreamRequestHandler):
    """The URCap's protocol; its jaws are closed by an object of 40 mm, and a motion takes two questions."""

    def handle(self):
        values, calls, self.wait = self.server.values, self.server.calls, 0
        for line in self.rfile:
            words = line.decode().split()
            calls.append(" ".join(words))
            if words[0] == "SET":
                values |= {name: int(value) for name, value in zip(words[1::2], words[2::2], strict=True)}
                if "POS" in words:
                    requested, held = values["POS"], self.server.object_at
                    stopped = requested > held
                    values |= {"PRE": requested, "POS": min(requested, held), "OBJ": 2 if stopped else 3}
                    self.wait = 2
                self.wfile.write(b"ack\n")
                continue
            value = values[words[1]]
            if words[1] == "OBJ" and self.wait:
                self.wait, value = self.wait - 1, 0
            self.wfile.write(f"{words[1]} {value}\n".encode())


@pytest.fixture
def robotiq():
    with serving(socketserver.ThreadingTCPServer, URCap) as server:
        server.values, server.calls = {"POS": 0, "PRE": 0, "OBJ": 3, "STA": 3}, []
        server.object_at = round(255 * (1 - 40 / 85))
        with load_gripper("robotiq_2f85:Robotiq2F85", host="127.0.0.1", port=server.server_address[1]) as gripper:
            yield server, gripper


def moves_and_reports(arm: Arm, yaw_rad: float = 0.5) -> None:
    goal = Pose(30.0, -40.0, 100.0, yaw_rad)
    reached = arm.move_to(goal, 150.0)
    assert reached.as_tuple() == pytest.approx(goal.as_tuple(), abs=1e-6)
    assert arm.pose() == reached


def test_a_ur_arm_moves_at_the_requested_speed_and_reports_the_pose_of_the_rigs_frame(ur):
    fake, arm = ur
    for yaw_rad in (-3.0, 0.7):
        moves_and_reports(arm, yaw_rad)
        assert fake.pose[:3] == pytest.approx([0.53, 0.06, 0.2])  # origin + pose, and the tool above the fingertips
    assert fake.calls == [("moveL", 0.15)] * 2


def test_a_ur_arm_is_stopped_after_a_protective_stop(ur):
    fake, arm = ur
    fake.is_stopped = True
    with pytest.raises(DeviceError, match="UR arm cannot move: the robot stopped itself; unlock it"):
        arm.move_to(Pose(0.0, 0.0, 100.0, 0.0), 100.0)
    assert fake.calls[-1] == "stopL"


@pytest.mark.parametrize("yaw_rad", [-2.0, 1.5])
def test_a_franka_arm_moves_at_the_requested_speed_and_reports_the_pose_of_the_rigs_frame(franka, yaw_rad):
    robot, _ = franka
    with load_arm("franka:FrankaArm", host="fr3", **ORIGIN) as arm:
        moves_and_reports(arm, yaw_rad)
        assert robot.calls == [("speed", 0.15), "move"]
        arm.recover()
        arm.stop()
        assert robot.calls[2:] == ["recover", "stop"]


def test_a_franka_hand_grasps_with_twice_the_force_on_each_finger(franka):
    _, hand = franka
    with load_gripper("franka:FrankaHand", host="fr3") as gripper:
        assert gripper.open(60.0).status == "idle"
        state = gripper.grasp(20.0, 50.0)
        assert (state.status, state.force_n) == ("holding", 20.0)
        assert state.opening_mm == pytest.approx(30.0)
        assert hand.calls == [("grasp", 0.05, 40.0)]
        hand.is_grasped = False
        assert gripper.state().status == "part_lost"
        hand.object_m = 0.0
        assert gripper.grasp(20.0, 50.0).status == "no_part"
        assert gripper.open(80.0).status == "idle"


def test_a_robotiq_gripper_grasps_opens_and_stops(robotiq):
    server, gripper = robotiq
    state = gripper.grasp(20.0, 85.0)
    assert (state.status, state.force_n) == ("holding", 20.0)
    assert state.opening_mm == pytest.approx(40.0, abs=0.4)
    assert "SET POS 255 SPE 127 FOR 23 GTO 1" in server.calls  # 85 mm/s; 40 N for both fingers
    server.object_at = 255
    assert gripper.grasp(20.0, 85.0).status == "no_part"
    opened = gripper.open(85.0)
    assert (opened.status, opened.opening_mm) == ("idle", 85.0)
    gripper.stop()
    assert server.calls[-1] == "SET GTO 0"


def test_a_robotiq_gripper_that_is_not_active_does_not_move(robotiq):
    server, gripper = robotiq
    server.values["STA"] = 0
    with pytest.raises(DeviceError, match="activate it on the teach pendant"):
        gripper.grasp(20.0, 85.0)
    assert not any("POS" in call for call in server.calls if call.startswith("SET"))


class Endpoint(BaseHTTPRequestHandler):
    """A robot program of another computer: it stores poses, refuses those below the table, and closes on an object."""

    def do_POST(self):
        values = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        server, status = self.server, 200
        server.calls.append(self.path)
        answer = {"/arm/pose": server.at, "/jaws/state": server.jaws}.get(self.path)
        content = b"" if answer is None else json.dumps(answer).encode()
        if self.path == "/arm/move_to" and values["z_mm"] < 50:
            content, status = b"protective stop", 409
        elif self.path == "/arm/move_to":
            del values["speed_mm_s"]
            server.at = values
        elif self.path == "/jaws/open":
            server.jaws = {"opening_mm": values["opening_mm"], "force_n": 0.0, "status": "idle"}
        elif self.path == "/jaws/grasp":
            server.jaws = {"opening_mm": 40.0, "force_n": values["force_n"], "status": "holding"}
        self.send_response(status)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_): ...


@pytest.fixture
def endpoint():
    """The server, and its address."""
    with serving(ThreadingHTTPServer, Endpoint) as server:
        server.at, server.calls = {"x_mm": 0.0, "y_mm": 0.0, "z_mm": 100.0, "yaw_rad": 0.0}, []
        server.jaws = {"opening_mm": 80.0, "force_n": 0.0, "status": "idle"}
        yield server, f"http://127.0.0.1:{server.server_address[1]}"


def test_an_arm_on_another_computer_moves_stops_and_its_errors_keep_their_text(endpoint):
    server, url = endpoint
    with load_arm("remote:RemoteArm", url=f"{url}/arm") as arm:
        assert server.calls == ["/arm/pose"]
        moves_and_reports(arm)
        with pytest.raises(DeviceError, match=r"/arm/move_to answered 409: protective stop"):
            arm.move_to(Pose(0.0, 0.0, 20.0, 0.0), 150.0)
    assert server.calls[-1] == "/arm/stop"


def test_a_gripper_on_another_computer_opens_and_grasps(endpoint):
    server, url = endpoint
    with load_gripper("remote:RemoteGripper", url=f"{url}/jaws", stroke_mm=85.0, min_force_n=5.0) as gripper:
        assert gripper.open(70.0).opening_mm == 70.0
        state = gripper.grasp(15.0, 40.0)
        assert (state.status, state.force_n) == ("holding", 15.0)
        gripper.stop()
    assert server.calls[-1] == "/jaws/stop"
