"""The WSG-50's driver with the emulated gripper, over TCP and a terminal: each method, each setting."""

import contextlib
import json
import math

import pytest

from robot.drivers.wsg50.driver import WSG50
from robot.errors import DeviceError, RobotConfigError
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.wsg50_bench import GRASP, HOME, PORTS, RELEASE, gripper_with_emulator


@PORTS
def test_it_grasps_holds_and_releases(port):
    with gripper_with_emulator(port) as (gripper, emulator):
        emulator.object_mm = 40.0
        held = gripper.grasp(10.0, 200.0)
        assert (held.opening_mm, held.force_n, held.status) == (pytest.approx(40.0), 10.0, "holding")
        assert gripper.state() == held
        opened = gripper.open(110.0)
        assert (opened.opening_mm, opened.force_n, opened.status) == (pytest.approx(110.0), 0.0, "idle")
        assert gripper.state() == opened
        assert gripper.line_counts == {}


def test_a_serial_line_has_its_baud_rate_and_stop_bits():
    with gripper_with_emulator("pty", baud=9600, stop_bits=2, update_ms=100) as (gripper, _):
        assert (gripper._link._port._serial.baudrate, gripper._link._port._serial.stopbits) == (9600, 2)
        assert gripper.state().status == "idle"


@PORTS
def test_closing_without_an_object_is_no_part_and_ends_by_opening_or_grasping(port):
    with gripper_with_emulator(port) as (gripper, emulator):
        assert gripper.grasp(10.0).status == "no_part"
        assert gripper.open(60.0).status == "idle"
        assert gripper.grasp(10.0).status == "no_part"
        emulator.object_mm = 3.0
        assert gripper.grasp(10.0).status == "holding"  # released by 5 mm before: GRASP is refused in NO PART
        assert emulator.received.count(RELEASE) == 2


@PORTS
def test_a_lost_part_is_reported_and_opening_ends_the_state(port):
    with gripper_with_emulator(port) as (gripper, emulator):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        emulator.object_mm = None
        assert gripper.state().status == "part_lost"
        assert gripper.open(110.0).status == "idle"


def test_grasping_a_held_object_grasps_it_again_with_the_new_force():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        assert gripper.grasp(20.0).force_n == 20.0


def test_opening_to_less_than_the_held_object_releases_it_first():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        with pytest.raises(DeviceError, match=r"AXIS_BLOCKED to MOVE .* rests at 40.0 mm"):
            gripper.open(20.0)
        assert emulator.force_limit_n == 5.0  # the smallest force, because it is not a grasp
        emulator.object_mm = None
        assert gripper.open(20.0).opening_mm == pytest.approx(20.0)


def test_force_is_that_on_each_finger_and_twice_as_much_for_the_gripper():
    with gripper_with_emulator(max_force_n=30.0) as (gripper, emulator):
        assert (gripper.min_force_n, gripper.max_force_n) == (2.5, 30.0)
        emulator.object_mm = 40.0
        assert gripper.grasp(12.5).force_n == 12.5
        assert emulator.force_limit_n == 25.0
        assert gripper.settings()["force_limit_n"] == 12.5
    with gripper_with_emulator(finger_share=1.0, max_force_n=300.0) as (gripper, emulator):
        assert (gripper.min_force_n, gripper.max_force_n) == (5.0, 80.0)
        gripper.grasp(12.5)
        assert emulator.force_limit_n == 12.5


def test_values_out_of_range_never_reach_the_gripper():
    with gripper_with_emulator(max_force_n=30.0, max_speed_mm_s=300.0, soft_limits_mm=[5.0, 100.0]) as (
        gripper,
        emulator,
    ):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        emulator.received.clear()
        for misuse in (
            lambda: gripper.grasp(2.4),
            lambda: gripper.grasp(30.1),
            lambda: gripper.grasp(math.nan),
            lambda: gripper.grasp(10.0, 4.9),
            lambda: gripper.grasp(10.0, 301.0),
            lambda: gripper.open(4.9),
            lambda: gripper.open(100.1),
        ):
            with pytest.raises(DeviceError, match="must be from"):
                misuse()
        assert emulator.received == []
        assert gripper.state().status == "holding"
    for settings in ({"acceleration_mm_s2": 5001.0}, {"soft_limits_mm": [50.0, 111.0]}):
        with gripper_with_emulator(connect=False, **settings) as (gripper, emulator):
            with pytest.raises(DeviceError, match="must be from"):
                gripper.connect()
            assert not {0x30, 0x34} & set(emulator.received)


def test_a_gripper_that_would_clamp_harder_than_requested_does_not_grasp():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.keeps_force_n = 60.0
        with pytest.raises(DeviceError, match=r"force limit \(both fingers\) must be 20 N, but the gripper has 60 N"):
            gripper.grasp(10.0)
        assert GRASP not in emulator.received
        assert gripper.refused["force_n"] == "requested 10, has 30"
        emulator.keeps_force_n = 16.0
        gripper.grasp(10.0)
        assert gripper.refused["force_n"] == "requested 10, has 8"
        emulator.keeps_force_n = None
        gripper.grasp(10.0)
        assert gripper.refused == {}


def test_a_force_limit_may_have_a_rounding_error_but_never_exceed_the_upper_limit():
    with gripper_with_emulator(max_force_n=10.0) as (gripper, emulator):
        for actual, requested in ((20.002, 10.0), (20.00001, 10.0), (10.01, 5.0)):
            emulator.keeps_force_n = actual
            with pytest.raises(DeviceError, match=r"force limit \(both fingers\) must be"):
                gripper.grasp(requested)
        emulator.keeps_force_n = 10.000005
        assert gripper.grasp(5.0).status == "no_part"
    with gripper_with_emulator(max_force_n=7.1, finger_share=0.3) as (
        gripper,
        emulator,
    ):  # 23.666..., which 32 bits round up
        gripper.grasp(7.1)
        assert 0.3 * emulator.force_limit_n == pytest.approx(7.1)
        assert 0.3 * emulator.force_limit_n <= 7.1


def test_a_nominal_width_outside_the_opening_range_is_refused():
    for settings in ({"grasp_width_mm": 111.0}, {"grasp_width_mm": 95.0, "soft_limits_mm": [0.0, 90.0]}):
        with gripper_with_emulator(connect=False, **settings) as (gripper, emulator):
            with pytest.raises(DeviceError, match="grasp_width_mm must be at most"):
                gripper.connect()
            assert not emulator.in_fast_stop
            assert 0x34 not in emulator.received


def test_only_the_states_have_automatic_updates():
    with gripper_with_emulator() as (gripper, emulator):
        gripper.open(80.0)
        assert 0x44 not in emulator.received
        assert emulator.received.count(0x43) == emulator.received.count(0x45)  # readings only


@pytest.mark.parametrize(("baud", "stop_bits", "ms", "fits"), [(9600, 1, 20, 0), (27499, 2, 20, 0), (27500, 2, 20, 1)])
def test_a_serial_line_must_have_room_for_more_than_the_updates(baud, stop_bits, ms, fits):
    """25 bytes of 11 bits every 20 ms are 13750 bits/s."""
    settings = {"baud": baud, "stop_bits": stop_bits, "update_ms": ms}
    WSG50(port="socket://127.0.0.1:1000", **settings)
    with contextlib.nullcontext() if fits else pytest.raises(RobotConfigError, match="baud must be at least"):
        WSG50(port="/dev/ttyUSB0", **settings)


def test_it_does_not_home_if_connecting_must_not_move_the_jaws():
    emulator = EmulatedWSG50(referenced=False, speed_up=20.0)
    with gripper_with_emulator(emulator=emulator, connect=False) as (gripper, _):
        gripper.may_move = False
        with pytest.raises(DeviceError, match="has lost its reference and must be homed, but motion is not allowed"):
            gripper.connect()
    assert HOME not in emulator.received
    assert emulator.opening_mm == 50.0


@PORTS
def test_it_homes_on_connecting_if_the_reference_is_lost(port, caplog):
    with gripper_with_emulator(port, emulator=EmulatedWSG50(speed_up=20.0)) as (gripper, emulator):
        assert emulator.received.count(HOME) == 1
        assert "homing, the jaws move" in caplog.text
        assert gripper.state().opening_mm == pytest.approx(110.0)
        assert gripper.home().status == "idle"
    with gripper_with_emulator(home_direction="in", emulator=EmulatedWSG50(speed_up=20.0)) as (gripper, _):
        assert gripper.state().opening_mm == pytest.approx(0.0)


def test_settings_are_written_and_read_back_as_plain_json():
    with gripper_with_emulator(acceleration_mm_s2=1500.0, soft_limits_mm=[5.0, 90.0], tare=True) as (gripper, emulator):
        settings = json.loads(json.dumps(gripper.settings()))
        assert settings["acceleration_mm_s2"] == 1500.0
        assert settings["soft_limits_mm"] == [5.0, 90.0]
        assert settings["info"] == {"kind": 1, "hardware": 6, "firmware": 0x4000, "serial": 20260101}
        assert settings["limits"]["max_speed_mm_s"] == 420.0
        assert set(gripper.refused) == {"tare"}
        assert "NOT_AVAILABLE" in gripper.refused["tare"]
        assert gripper.stroke_mm == 90.0
        with pytest.raises(DeviceError, match="opening"):
            gripper.open(4.0)
        emulator.has_force_fingers, emulator.soft_limits = True, (0.0, 80.0)
        gripper.recover()
        assert (gripper.refused, emulator.soft_limits) == ({}, (5.0, 90.0))


def test_a_grasp_thinner_than_a_part_is_no_part():
    with gripper_with_emulator(min_part_mm=5.0) as (gripper, emulator):
        emulator.object_mm = 4.0
        assert gripper.grasp(10.0).status == "no_part"


@pytest.mark.parametrize(
    "settings",
    [
        {"baud": 0},
        {"stop_bits": 3},
        {"timeout_s": math.nan},
        {"home_direction": "up"},
        {"soft_limits_mm": [1.0]},
        {"soft_limits_mm": [9.0, 1.0]},
        {"soft_limits_mm": [math.nan, 1.0]},
        {"finger_share": 0.0},
        {"reconnect_tries": 0},
        {"max_force_n": 0.0},
        {"update_ms": 300, "max_state_age_s": 0.5},
        {"baud": "x"},
    ],
)
def test_a_setting_out_of_range_is_refused(settings):
    with pytest.raises(RobotConfigError, match="must"):
        WSG50(port="loop://", **settings)


@pytest.mark.parametrize("settings", [{"max_force_n": 2.0}, {"max_speed_mm_s": 4.0}])
def test_limits_below_the_grippers_minimum_are_refused_on_connecting(settings):
    with gripper_with_emulator(connect=False, **settings) as (gripper, emulator):
        with pytest.raises(RobotConfigError, match="limits must allow"):
            gripper.connect()
        assert not gripper.is_connected
        assert not emulator.in_fast_stop
