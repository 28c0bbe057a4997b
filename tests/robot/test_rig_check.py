"""The check of a rig: each device on its own, each failure a row."""

import pytest

from robot import rig_check
from robot.readings import GripperState, Pose
from robot.rig_check import check_rig
from tests.fake_rig import FakeGripper, FakeRig, FakeSensor


@pytest.fixture(autouse=True)
def _short_measurement(monkeypatch):
    monkeypatch.setattr(rig_check, "MEASURE_S", 0.1)


@pytest.fixture
def rig():
    return FakeRig(5)


def test_every_device_is_checked_moved_back_and_closed(rig):
    rows = list(check_rig(rig))
    assert [row.role for row in rows] == ["arm", "gripper", "gel", "gel", "camera", "skew"]
    assert not any(row.failure for row in rows)
    assert rows[0].measured["moved"] == "10 mm in 0.50 s"
    assert rows[1].measured["moved"] == "5 mm, off by 0.00 mm"
    assert rows[2].measured["size"] == "32 x 24"
    assert rows[4].measured["depth known"].endswith("of the pixels")
    assert rows[5].measured["apart"] == "0.0 ms"
    assert not any(device.is_connected for device in rig.devices)
    assert rig.shared.pose == Pose(0, 0, 300, 0)
    assert rig.shared.opening == 110.0
    assert "grasp" not in rig.shared.calls


def test_without_motion_arm_and_jaws_do_not_move(rig):
    rows = list(check_rig(rig, motion=False))
    assert rows[0].measured["motion"] == "none"
    assert {"arm", "open", "grasp"}.isdisjoint(rig.shared.calls)


def test_a_device_that_fails_is_a_row_and_the_others_are_still_checked(rig):
    rig.shared.faults = {"gripper.connect": {1}, "gel b": {1}}
    rows = {row.device: row for row in check_rig(rig)}
    assert rows["fake gripper"].failure == "the fake gripper.connect fails on purpose"
    assert rows["fake gel b"].failure == "the fake gel b fails on purpose"
    assert rows["fake camera"].failure is None
    assert rows["fake gripper"].line() == "FAIL  gripper   fake gripper: the fake gripper.connect fails on purpose"
    assert not any(device.is_connected for device in rig.devices)


def test_a_held_object_is_not_released(rig, monkeypatch):
    monkeypatch.setattr(FakeGripper, "_state", lambda self: GripperState(40.0, 10.0, "holding"))
    monkeypatch.setattr(FakeGripper, "_open", lambda *_: pytest.fail("it opened"))
    (row,) = [row for row in check_rig(rig) if row.role == "gripper"]
    assert row.measured["motion"] == "none, because it is holding"


def test_a_manual_arm_is_not_moved(rig, monkeypatch):
    monkeypatch.setattr(type(rig.arm), "is_manual", True)
    row = next(check_rig(rig))
    assert row.measured == {"moved": "by a person"}
    assert "arm" not in rig.shared.calls


def test_a_frozen_stream_counts_as_one_frame_and_the_promised_rate_is_next_to_the_measured_one(rig, monkeypatch):
    monkeypatch.setattr(FakeSensor, "_settings", lambda self: {"fps": 60.0})
    row = next(row for row in check_rig(rig) if row.role == "gel")
    assert row.measured["rate"] == "500.0 frames/s"  # one at each read, every 2 ms
    assert row.measured["promised"] == "60 frames/s"
    first = {}
    real = FakeSensor._read
    monkeypatch.setattr(FakeSensor, "_read", lambda self: first.setdefault(self.finger, real(self)))
    row = next(row for row in check_rig(rig) if row.role == "gel")
    assert row.measured["rate"] == "1 frame(s) in 0.1 s"
