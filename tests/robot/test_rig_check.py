"""The check of a rig: each device on its own, each failure a row."""

import pytest

from robot import rig_check
from robot.drivers.discover import UsbPort
from robot.errors import RobotConfigError
from robot.readings import Frame, GripperState, Pose
from robot.rig_check import check_rig
from tests.fake_rig import FakeGripper, FakeRig, FakeSensor


@pytest.fixture(autouse=True)
def _short_measurement(monkeypatch):
    monkeypatch.setattr(rig_check, "MEASURE_S", 0.2)


@pytest.fixture
def rig():
    return FakeRig(5)


@pytest.fixture
def real_rig(rig, monkeypatch):
    """The fake rig as a rig of real cameras, with an object on the table."""
    rig.prepare("round-1", 0)
    monkeypatch.setattr(FakeRig, "can_run_jobs", False)
    return rig


def test_every_device_is_checked_moved_back_and_closed(rig):
    rows = list(check_rig(rig))
    assert [(row.role, row.failure) for row in rows] == [
        ("arm", None),
        ("gripper", None),
        ("gel", None),
        ("gel", None),
        ("camera", None),
        ("skew", None),
    ]
    assert rows[0].measured["moved"] == "10 mm in 0.50 s"
    assert rows[1].measured["moved"] == "5 mm, off by 0.00 mm"
    assert rows[2].measured["size"] == "32 x 24"
    assert rows[4].measured["depth known"].endswith(" m")
    assert rows[5].measured["apart"] == "0.0 ms (max 0.0)"
    assert not any(device.is_connected for device in rig.devices)
    assert rig.shared.pose == Pose(0, 0, 300, 0)
    assert rig.shared.opening == 110.0
    assert "grasp" not in rig.shared.calls


def test_without_motion_arm_and_jaws_do_not_move(rig):
    rows = list(check_rig(rig, motion=False))
    assert rows[0].measured["motion"] == "none"
    assert rows[0].measured["answer to a query in"].startswith("0.00 ms")
    assert {"arm", "open", "grasp"}.isdisjoint(rig.shared.calls)


def test_a_configuration_error_on_connecting_is_a_row_too(rig, monkeypatch):
    def wrong(self):
        raise RobotConfigError("the calibration is for another size")

    monkeypatch.setattr(FakeSensor, "_connect", wrong)
    rows = list(check_rig(rig))
    assert [row.role for row in rows if row.failure] == ["gel", "gel", "skew"]


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


def test_a_frozen_stream_counts_as_one_frame(rig, monkeypatch):
    monkeypatch.setattr(rig_check, "MEASURE_S", 0.1)
    first = {}
    real = FakeSensor._read
    monkeypatch.setattr(FakeSensor, "_read", lambda self: first.setdefault(self.finger, real(self)))
    row = next(row for row in check_rig(rig) if row.role == "gel")
    assert row.measured["rate"] == "1 frame(s) in 0.1 s"


def test_the_promised_rate_is_next_to_the_measured_one(rig, monkeypatch):
    monkeypatch.setattr(FakeSensor, "_settings", lambda self: {"fps": 60.0})
    row = next(row for row in check_rig(rig) if row.role == "gel")
    assert row.measured["rate"] == "500.0 frames/s"  # one at each read, every 2 ms
    assert row.measured["promised"] == "60 frames/s"
    assert row.measured["dropped"] == "0"
    assert "USB" not in row.measured


def test_dropped_frames_are_gaps_in_the_times(rig, monkeypatch):
    """Frames of 100 Hz, of which those from 0.05 to 0.07 s never arrive."""
    real = FakeSensor._read

    def read(self):
        frame = real(self)
        number = int((frame.time_s - began) * 100 + 1e-6)
        return Frame(frame.pixels, began + (4 if number in (5, 6, 7) else number) / 100)

    began = rig.clock()
    monkeypatch.setattr(FakeSensor, "_read", read)
    row = next(row for row in check_rig(rig, motion=False) if row.role == "gel")
    assert row.measured["dropped"] == "3"


def test_cameras_that_starve_each_other_on_one_usb_bus_are_a_failure_that_names_them(real_rig, monkeypatch):
    ports = {"a": UsbPort(3, "1.2", 480), "b": UsbPort(3, "1.4", 480)}
    monkeypatch.setattr(FakeSensor, "_settings", lambda self: {"device": self.finger})
    monkeypatch.setattr(rig_check, "usb_port", ports.get)
    real = FakeSensor._read

    def starved(self):
        frame = real(self)
        step_s = 0.05 if self.finger == "b" and real_rig.camera.is_connected else 0.01
        return Frame(frame.pixels, step_s * int(frame.time_s / step_s))

    monkeypatch.setattr(FakeSensor, "_read", starved)
    rows = {row.role: row for row in check_rig(real_rig, motion=False)}
    assert rows["gel"].measured["USB"] == "bus 3, port 1.4, 480 Mbit/s"
    assert rows["together"].failure == (
        "with all cameras, frames are lost: fake gel b 20.0 frames/s, alone 100.0; fake gel a and fake gel b share USB "
        "bus 3 (480 Mbit/s). Connect the cameras to different USB controllers, or lower width, height or fps"
    )
