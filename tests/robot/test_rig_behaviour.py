"""Behaviour of every rig: one suite over a table of rigs. The rig of a new driver is a row here."""

import contextlib
import dataclasses
import json
import math

import numpy as np
import pytest

from robot.devices import read_together
from robot.errors import DeviceError
from robot.readings import Pose
from robot.rig import Rig, load_rig
from tests.emulated_rig import emulated_rig
from tests.fake_rig import FakeRig

RIGS = {
    "fake": lambda: contextlib.nullcontext(FakeRig(5)),
    "sim": lambda: contextlib.nullcontext(load_rig("sim", seed=5)),
    "emulated": lambda: emulated_rig(5),
}
"""Rigs by name, each a context in which its devices exist."""


@pytest.fixture(params=sorted(RIGS))
def unconnected(request):
    with RIGS[request.param]() as rig:
        yield rig


@pytest.fixture
def rig(unconnected):
    """A connected rig with its first object on the table."""
    with unconnected as rig:
        rig.prepare(rig.object_ids(1)[0], 0)
        yield rig


def middle(rig, fraction=0.5):
    lower, upper = np.array(rig.arm.workspace.lower), np.array(rig.arm.workspace.upper)
    x, y, z = (lower + fraction * (upper - lower)).tolist()
    return Pose(x, y, z, 0.3)


def test_a_rig_has_the_info_that_a_recording_requires(unconnected: Rig):
    assert {"source", "sensor"} <= set(unconnected.info)
    assert set(unconnected.sensors) <= {"a", "b"}
    assert unconnected.sensors
    names = unconnected.object_ids(5)
    assert len(set(names)) == 5
    assert unconnected.object_ids(3) == names[:3]


def test_it_connects_closes_twice_and_connects_again(unconnected: Rig):
    unconnected.close()
    for _ in range(2):
        unconnected.connect()
        assert all(device.is_connected for device in unconnected.devices)
        unconnected.close()
        unconnected.close()
        assert not any(device.is_connected for device in unconnected.devices)


def test_stopping_still_devices_and_recovering_working_ones_changes_nothing(rig: Rig):
    rig.arm.move_to(middle(rig), 100.0)
    before = rig.gripper.open(40.0)
    rig.gripper.stop()
    rig.recover()
    after = rig.gripper.state()
    assert after.opening_mm == pytest.approx(before.opening_mm, abs=0.5)
    assert after.status == "idle"
    rig.arm.stop()
    rig.arm.move_to(middle(rig), 100.0)
    assert math.dist(rig.arm.pose().as_tuple(), middle(rig).as_tuple()) < 1.0


def test_a_stopped_motion_leaves_still_jaws_that_can_be_opened(rig: Rig, monkeypatch):
    def failing(*_):
        raise KeyboardInterrupt

    stopped, real = [], rig.gripper._stop
    with monkeypatch.context() as patched:
        patched.setattr(rig.gripper, "_grasp", failing)
        patched.setattr(rig.gripper, "_stop", lambda: stopped.append(real()))
        with pytest.raises(KeyboardInterrupt):
            rig.gripper.grasp(rig.gripper.min_force_n)
    assert len(stopped) == 1
    first = rig.gripper.state().opening_mm
    assert rig.gripper.state().opening_mm == pytest.approx(first, abs=0.5)
    assert rig.gripper.open(rig.gripper.stroke_mm).status == "idle"


def test_the_arm_moves_to_its_target_and_refuses_poses_outside_the_workspace(rig: Rig):
    target = middle(rig)
    reached = rig.arm.move_to(target, 100.0)
    assert math.dist(reached.as_tuple(), target.as_tuple()) < 1.0
    with pytest.raises(DeviceError, match="workspace"):
        rig.arm.move_to(dataclasses.replace(target, y_mm=1e5), 100.0)
    assert math.dist(rig.arm.pose().as_tuple(), target.as_tuple()) < 1.0


def test_the_gripper_opens_refuses_forces_out_of_range_and_reports_no_part(rig: Rig):
    gripper = rig.gripper
    assert 0 < gripper.min_force_n < gripper.max_force_n
    state = gripper.open(gripper.stroke_mm)
    assert state.opening_mm == pytest.approx(gripper.stroke_mm, abs=1.0)
    assert state.status == "idle"
    for force in (0.9 * gripper.min_force_n, 1.1 * gripper.max_force_n):
        with pytest.raises(DeviceError, match="force"):
            gripper.grasp(force)
    assert gripper.state() == state
    rig.arm.move_to(middle(rig, 0.95), 100.0)
    assert gripper.grasp(gripper.min_force_n).status == "no_part"
    assert gripper.open(gripper.stroke_mm).status == "idle"


def test_frames_pictures_and_settings_are_fresh_and_of_the_stated_form(rig: Rig):
    for finger, sensor in rig.sensors.items():
        frame = sensor.read()
        assert sensor.finger == finger
        assert frame.pixels.dtype == np.uint8
        assert frame.pixels.shape[2] == 3
        assert abs(rig.clock() - frame.time_s) < 0.5
        assert frame.pixels.std() > 0
    frames, skew_s = read_together(rig.sensors)
    assert set(frames) == set(rig.sensors)
    assert 0 <= skew_s < 0.1
    assert set(json.loads(json.dumps(rig.settings()))) == {device.name for device in rig.devices}


def test_the_camera_returns_colour_and_depth_that_put_the_table_near_zero(rig: Rig):
    image, pose = rig.camera.read(), rig.camera.extrinsics
    assert image.colour.shape[:2] == image.depth_m.shape
    assert rig.camera.read(depth=False).depth_m is None
    assert pose[2, 3] > 0
    rows, columns = np.nonzero(np.isfinite(image.depth_m))
    depth, lens = image.depth_m[rows, columns] * 1000.0, image.intrinsics
    assert np.median(depth) > 100
    local = np.stack([(columns - lens.cx) / lens.fx * depth, (rows - lens.cy) / lens.fy * depth, depth], 1)
    height = (local @ pose[:3, :3].T + pose[:3, 3])[:, 2]
    assert abs(np.median(height[height < 20])) < 10


def test_a_rig_that_can_run_jobs_prepares_from_seed_object_and_number_alone(unconnected: Rig):
    if not unconnected.can_run_jobs:
        pytest.skip("this rig can run only once")
    pictures = []
    with unconnected as rig:
        first, second = rig.object_ids(2)
        for object_id, number in ((first, 3), (second, 1), (first, 3)):
            rig.prepare(object_id, number)
            pictures.append(rig.camera.read())
    first, other, again = pictures
    assert (first.colour == again.colour).all()
    np.testing.assert_array_equal(first.depth_m, again.depth_m)
    assert (first.colour != other.colour).any()
