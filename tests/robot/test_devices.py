"""The base classes of devices: their checks of arguments and of results."""

import math

import numpy as np
import pytest

from robot.devices import Camera, Device, TactileSensor
from robot.errors import DeviceError, RobotConfigError
from robot.readings import RGBD, Frame, GripperState, Intrinsics, Pose, Region
from tests.fake_rig import FORCE_N, STROKE_MM, FakeArm, FakeGripper, FakeRigState


class Plug(Device):
    """A device that records calls and fails on request."""

    def __init__(self, connects=True, closes=True):
        super().__init__("plug")
        self.connects, self.closes, self.calls = connects, closes, []

    def _connect(self):
        self.calls.append("connect")
        if not self.connects:
            raise OSError(110, "Connection timed out")

    def _close(self):
        self.calls.append("close")
        if not self.closes:
            raise OSError(5, "Input/output error")


class Gel(TactileSensor):
    """A sensor that returns a given frame."""

    def __init__(self, frame, now=100.0):
        super().__init__("gel", "a", clock=lambda: now)
        self.frame = frame

    def _connect(self): ...
    def _close(self): ...
    def _read(self):
        return self.frame


class Eye(Camera):
    """A camera that returns a given picture and records requests for depth."""

    def __init__(self, image, extrinsics=None):
        super().__init__("eye", np.eye(4) if extrinsics is None else extrinsics, clock=lambda: image.time_s)
        self.image, self.depth_requests = image, []

    def _connect(self): ...
    def _close(self): ...
    def _read(self, depth):
        self.depth_requests.append(depth)
        return self.image


def picture(depth=True, shape=(4, 6)):
    depth_m = np.full(shape, 0.9, np.float32) if depth else None
    return RGBD(np.zeros((4, 6, 3), np.uint8), depth_m, Intrinsics(1, 1, 0, 0), 3.0)


@pytest.mark.parametrize("closes", [True, False])
def test_a_device_that_fails_to_connect_is_closed_and_can_be_tried_again(closes):
    plug = Plug(connects=False, closes=closes)
    with pytest.raises(DeviceError, match="plug cannot be connected: Connection timed out") as caught:
        plug.connect()
    assert hasattr(caught.value, "__notes__") is not closes
    assert plug.calls == ["connect", "close"]
    plug.close()
    plug.connects = True
    plug.connect()
    plug.connect()
    assert plug.is_connected
    assert plug.calls == ["connect", "close", "connect"]
    if not closes:
        with pytest.raises(DeviceError, match="plug cannot be closed: Input/output error"):
            plug.close()
    plug.close()
    assert not plug.is_connected


@pytest.mark.parametrize(
    "use",
    [
        lambda: Plug().settings(),
        lambda: FakeArm(FakeRigState(0)).move_to(Pose(0, 0, 100, 0), 10),
        lambda: FakeArm(FakeRigState(0)).pose(),
        lambda: FakeGripper(FakeRigState(0)).state(),
        lambda: FakeGripper(FakeRigState(0)).open(10),
        lambda: FakeGripper(FakeRigState(0)).grasp(10),
        lambda: Gel(None).read(),
        lambda: Eye(picture()).read(),
    ],
)
def test_no_device_can_be_used_before_it_is_connected(use):
    with pytest.raises(DeviceError, match="must be connected before it is used"):
        use()


def test_a_pose_out_of_the_workspace_never_reaches_the_arm():
    outside = [(151, 0, 100, 0), (0, -151, 100, 0), (0, 0, 7.9, 0), (0, 0, math.nan, 0), (0, 0, 9, math.inf)]
    with FakeArm(FakeRigState(0)) as arm:
        for speed in (0, math.nan, 1001):
            with pytest.raises(DeviceError, match="speed must be"):
                arm.move_to(Pose(0, 0, 100, 0), speed)
        for pose in outside:
            with pytest.raises(DeviceError, match="must be in the workspace"):
                arm.move_to(Pose(*pose), 100)
        assert "arm" not in arm.shared.calls
        arm.move_to(Pose(150, -150, 8, 0), 100)  # the faces belong to the workspace
        assert arm.pose() == Pose(150, -150, 8, 0)


def test_a_pose_that_is_not_finite_is_never_returned(monkeypatch):
    lost = Pose(9, 9, 9, math.inf)
    monkeypatch.setattr(FakeArm, "_pose", lambda arm: lost)
    monkeypatch.setattr(FakeArm, "_move_to", lambda arm, pose, speed: lost)
    with FakeArm(FakeRigState(0)) as arm:
        for read in (arm.pose, lambda: arm.move_to(Pose(0, 0, 100, 0), 100)):
            with pytest.raises(DeviceError, match="fake arm: the reported pose must be finite"):
                read()


@pytest.mark.parametrize("fault", [RuntimeError("it broke"), OSError("it broke"), KeyboardInterrupt("it broke")])
def test_an_exception_of_a_driver_stops_the_arm_and_is_a_device_error_unless_it_is_ctrl_c(fault, monkeypatch):
    def fail(*_):
        raise fault

    stops = []
    monkeypatch.setattr(FakeArm, "_move_to", fail)
    monkeypatch.setattr(FakeArm, "_stop", lambda arm: stops.append(arm))
    with FakeArm(FakeRigState(0)) as arm:
        with pytest.raises(DeviceError if isinstance(fault, Exception) else KeyboardInterrupt, match="it broke"):
            arm.move_to(Pose(0, 0, 100, 0), 100)
        assert stops == [arm]


def test_an_arm_that_does_not_arrive_is_stopped_and_the_message_says_how_far_it_is(monkeypatch):
    stops = []
    monkeypatch.setattr(FakeArm, "_move_to", lambda arm, pose, speed: Pose(pose.x_mm - 12, pose.y_mm, pose.z_mm, 0.5))
    monkeypatch.setattr(FakeArm, "_stop", lambda arm: stops.append(arm))
    with FakeArm(FakeRigState(0)) as arm:
        with pytest.raises(DeviceError, match=r"within 10 mm and 5 deg of its goal .* is 12\.0 mm and 0\.0 deg away"):
            arm.move_to(Pose(0, 0, 100, 0.5), 100)
        assert stops == [arm]


@pytest.mark.parametrize("outside", [-0.01, 0.01, math.nan])
def test_a_force_or_an_opening_out_of_range_never_reaches_the_gripper(outside):
    force, opening = (FORCE_N[0], 0.0) if outside < 0 else (FORCE_N[1], STROKE_MM)
    with FakeGripper(FakeRigState(0)) as gripper:
        with pytest.raises(DeviceError, match="fake gripper: force must be from 5 to 80 N, got"):
            gripper.grasp(force + outside)
        with pytest.raises(DeviceError, match="opening must be from 0 to 110 mm"):
            gripper.open(opening + outside)
        assert {"grasp", "open"}.isdisjoint(gripper.shared.calls)
        assert gripper.open(STROKE_MM) == GripperState(STROKE_MM, 0.0, "idle")


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (Intrinsics, (1, 0, 0, 0), "intrinsics"),
        (Intrinsics, (1, 1, math.inf, 0), "intrinsics"),
        (GripperState, (1.0, 0.0, "lost"), "status"),
        (GripperState, (math.nan, 0.0, "idle"), "finite"),
        (Region, ((0, 0, 0), (1, 1, 0)), "lower < upper"),
        (Region, ((0, 0, 0), (1, 1, math.nan)), "lower < upper"),
    ],
)
def test_a_reading_outside_the_contract_is_refused(kind, values, message):
    with pytest.raises((DeviceError, RobotConfigError), match=message):
        kind(*values)


def frame(age=0.0, now=100.0, pixels=None):
    return Frame(np.zeros((2, 3, 3), np.uint8) if pixels is None else pixels, now - age)


@pytest.mark.parametrize("age", [0.51, -0.06, math.nan])
def test_a_stale_frame_and_one_from_the_future_are_refused_and_the_caller_sets_the_largest_age(age):
    with Gel(frame(age)) as gel, pytest.raises(DeviceError, match=r"gel: the frame's age .* -0\.05 to 0\.5 s"):
        gel.read()
    with Gel(frame(0.3)) as gel:
        gel.read(max_age_s=0.3 + 1e-9)
        with pytest.raises(DeviceError, match=r"to 0\.2 s, got 0\.3 s"):
            gel.read(max_age_s=0.2)


@pytest.mark.parametrize(
    ("shape", "kind"), [((2, 3), np.uint8), ((2, 3, 4), np.uint8), ((2, 3, 3), float), ((0, 3, 3), np.uint8)]
)
def test_a_frame_that_is_not_8_bit_colour_is_refused(shape, kind):
    pixels = np.zeros(shape, kind)
    with Gel(frame(pixels=pixels)) as gel, pytest.raises(DeviceError, match="must be H x W x 3 uint8"):
        gel.read()


def test_depth_is_neither_read_nor_returned_unless_requested():
    with Eye(picture()) as eye:
        assert eye.read(depth=False).depth_m is None
        assert eye.read().depth_m.shape == (4, 6)
        assert eye.depth_requests == [False, True]


@pytest.mark.parametrize("image", [picture(depth=False), picture(shape=(4, 5))])
def test_requested_depth_that_is_missing_or_of_another_size_is_refused(image):
    with Eye(image) as eye:
        eye.read(depth=False)
        with pytest.raises(DeviceError, match="depth must be float32"):
            eye.read()


def test_extrinsics_are_a_rigid_motion():
    skewed, mirrored, short = np.eye(4), np.diag([1.0, 1, -1, 1]), np.eye(3)
    skewed[0, 1] = 0.1
    for wrong in (skewed, mirrored, short, np.full((4, 4), np.nan)):
        with pytest.raises(RobotConfigError, match="extrinsics must"):
            Eye(picture(), wrong)
