"""The WSG-50's driver with an emulated gripper."""

import contextlib
import logging
import os
import signal
import threading

import pytest

from robot.drivers.wsg50 import codec
from robot.drivers.wsg50 import driver as wsg50
from robot.drivers.wsg50.codec import Status
from robot.drivers.wsg50.driver import WSG50, Link, LinkLost
from robot.errors import DeviceError, RobotConfigError
from tests.emulators.wsg50.faults import LineFaults
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.server import serve
from tests.waiting import wait_until

QUICK = {"timeout_s": 2.0, "max_state_age_s": 0.5}
DISCONNECT, HOME, STOP, FAST_STOP, ACK, GRASP, RELEASE = 0x07, 0x20, 0x22, 0x23, 0x24, 0x25, 0x26


@contextlib.contextmanager
def gripper_with_emulator(faults=None, connect=True, emulator=None, **settings):
    """Yield a driver, connected or not, and its emulated gripper."""
    emulator = emulator or EmulatedWSG50(referenced=True, speed_up=20.0)
    with serve(emulator, faults) as port:
        gripper = WSG50(host="127.0.0.1", port=port, **QUICK | settings)
        if connect:
            gripper.connect()
        try:
            yield gripper, emulator
        finally:
            with contextlib.suppress(DeviceError):
                gripper.close()


def slow(**settings):
    return EmulatedWSG50(**{"referenced": True, "opening_mm": 100.0} | settings)


def test_it_grasps_holds_and_releases():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.object_mm = 40.0
        held = gripper.grasp(10.0, 200.0)
        assert (held.opening_mm, held.force_n, held.status) == (pytest.approx(40.0), 10.0, "holding")
        assert gripper.state() == held
        assert gripper.grasp(20.0).force_n == 20.0  # released and grasped again
        opened = gripper.open(110.0)
        assert (opened.opening_mm, opened.force_n, opened.status) == (pytest.approx(110.0), 0.0, "idle")
        assert gripper.state() == opened


def test_no_part_and_a_lost_part_end_by_opening_or_grasping():
    with gripper_with_emulator() as (gripper, emulator):
        assert gripper.grasp(10.0).status == "no_part"
        assert gripper.open(60.0).status == "idle"
        assert gripper.grasp(10.0).status == "no_part"
        emulator.object_mm = 3.0
        assert gripper.grasp(10.0).status == "holding"  # released by 5 mm before: GRASP is refused in NO PART
        assert emulator.received.count(RELEASE) == 2
        emulator.object_mm = None
        assert gripper.state().status == "part_lost"
        assert gripper.open(110.0).status == "idle"
        emulator.object_mm = 0.5
        assert gripper.grasp(10.0).status == "no_part"  # thinner than any part


def test_opening_to_less_than_the_held_object_releases_it_first():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        with pytest.raises(DeviceError, match=r"AXIS_BLOCKED to MOVE .* rests at 40.0 mm"):
            gripper.open(20.0)
        assert emulator.force_limit_n == 5.0  # the smallest force, because it is not a grasp


def test_force_is_that_on_each_finger_and_twice_as_much_for_the_gripper():
    with gripper_with_emulator(max_force_n=30.0) as (gripper, emulator):
        assert (gripper.min_force_n, gripper.max_force_n) == (2.5, 30.0)
        emulator.object_mm = 40.0
        assert gripper.grasp(12.5).force_n == 12.5
        assert emulator.force_limit_n == 25.0
        for force_n, speed_mm_s in ((2.4, 80.0), (30.1, 80.0), (10.0, 4.9), (10.0, 421.0)):
            with pytest.raises(DeviceError, match="must be from"):
                gripper.grasp(force_n, speed_mm_s)
        assert gripper.state().status == "holding"
    with gripper_with_emulator(max_force_n=7.1, finger_share=0.3) as (gripper, emulator):
        gripper.grasp(7.1)  # 23.666..., which 32 bits round up
        assert 0.3 * emulator.force_limit_n == pytest.approx(7.1)
        assert 0.3 * emulator.force_limit_n <= 7.1


def test_a_gripper_that_would_clamp_harder_than_requested_does_not_grasp():
    with gripper_with_emulator(max_force_n=20.0) as (gripper, emulator):
        for has, requested in ((60.0, 10.0), (20.002, 10.0), (40.01, 20.0)):
            emulator.keeps_force_n = has
            with pytest.raises(DeviceError, match=r"force limit \(both fingers\) must be"):
                gripper.grasp(requested)
        assert GRASP not in emulator.received
        emulator.keeps_force_n = 16.0
        gripper.grasp(10.0)
        assert gripper.refused["force_n"] == "requested 10, has 8"
        emulator.keeps_force_n = 20.00001  # a rounding error
        gripper.grasp(10.0)
        assert gripper.refused == {}


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"max_force_n": 2.0}, "must allow"),
        ({"grasp_width_mm": 111.0}, "grasp_width_mm"),
    ],
)
def test_settings_beyond_the_grippers_limits_are_refused_on_connecting(settings, error):
    with gripper_with_emulator(connect=False, **settings) as (gripper, emulator):
        with pytest.raises((RobotConfigError, DeviceError), match=error):
            gripper.connect()
        assert not gripper.is_connected
        assert not emulator.in_fast_stop


def test_it_homes_on_connecting_if_the_reference_is_lost_and_motion_is_allowed(caplog):
    with gripper_with_emulator(emulator=EmulatedWSG50(speed_up=20.0)) as (gripper, emulator):
        assert emulator.received.count(HOME) == 1
        assert "homing, the jaws move" in caplog.text
        assert gripper.state().opening_mm == pytest.approx(110.0)
        emulator.lose_reference()
        with pytest.raises(DeviceError, match="reference"):
            gripper.grasp(10.0)
        assert GRASP not in emulator.received
    emulator = EmulatedWSG50(speed_up=20.0)
    with gripper_with_emulator(emulator=emulator, connect=False) as (gripper, _):
        gripper.may_move = False
        with pytest.raises(DeviceError, match="must be homed, but motion is not allowed"):
            gripper.connect()
    assert HOME not in emulator.received


def test_a_fast_stop_is_named_and_never_acknowledged_silently(caplog):
    with gripper_with_emulator(connect=False) as (gripper, emulator):
        emulator.fail("current")
        with pytest.raises(DeviceError, match=r"FAST STOP: current fault; .* acknowledge_faults"):
            gripper.connect()
        assert ACK not in emulator.received
    with gripper_with_emulator(connect=False, acknowledge_faults=True) as (gripper, emulator):
        emulator.fail("current")
        caplog.clear()
        gripper.connect()
        texts = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
        assert texts == ["WSG-50 is in FAST STOP (current fault): acknowledging it"]


def test_after_a_fast_stop_every_call_raises_until_recovery():
    with gripper_with_emulator(acknowledge_faults=True) as (gripper, emulator):
        emulator.fail("temperature")
        for use in (gripper.state, lambda: gripper.open(50.0), lambda: gripper.grasp(10.0)):
            with pytest.raises(DeviceError, match=r"temperature fault.*recover\(\)"):
                use()
        emulator.lose_reference()
        gripper.recover()
        assert emulator.received.count(HOME) == 1
        assert gripper.open(50.0).status == "idle"


def test_a_held_object_keeps_its_force_when_the_program_reconnects():
    emulator = EmulatedWSG50(referenced=True, speed_up=20.0, object_mm=40.0)
    with gripper_with_emulator(emulator=emulator) as (gripper, _):
        gripper.grasp(10.0)
        gripper.close()
        assert emulator.received[-1] == DISCONNECT
    with gripper_with_emulator(emulator=emulator) as (gripper, _):
        assert not emulator.in_fast_stop
        assert (emulator.force_limit_n, gripper.state().status) == (20.0, "holding")
        gripper.open(60.0)
        gripper.recover()
        assert emulator.force_limit_n == 5.0


def test_missing_state_updates_stop_the_motion():
    emulator = slow(object_mm=5.0)
    with gripper_with_emulator(emulator=emulator, max_state_age_s=0.1) as (gripper, _):
        emulator.mute_updates = True
        with pytest.raises(DeviceError, match=r"at most 0.1 s old"):
            gripper.grasp(10.0, 5.0)
        assert not emulator.moves


def test_a_fault_during_a_motion_is_named():
    emulator = slow()
    with gripper_with_emulator(emulator=emulator) as (gripper, _):
        thread = threading.Thread(target=lambda: (wait_until(lambda: emulator.moves), emulator.fail("current")))
        thread.start()
        with pytest.raises(DeviceError, match=r"answered CMD_ABORTED to GRASP .* current fault"):
            gripper.grasp(10.0, 10.0)
        thread.join()


def test_a_motion_that_never_ends_is_stopped(monkeypatch):
    monkeypatch.setattr(wsg50, "_SLACK_S", 0.0)
    with gripper_with_emulator() as (gripper, emulator):
        emulator.jammed = True
        with pytest.raises(DeviceError, match=r"did not end GRASP \(25h\) in time"):
            gripper.grasp(10.0, 400.0)
        assert not emulator.moves
        assert emulator.received.count(GRASP) == 1
        emulator.jammed = False
        assert gripper.grasp(10.0).status == "no_part"


def test_ctrl_c_stops_the_jaws():
    emulator = slow()
    with gripper_with_emulator(emulator=emulator) as (gripper, _):

        def interrupt():
            wait_until(lambda: emulator.moves)
            os.kill(os.getpid(), signal.SIGINT)

        thread = threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            gripper.grasp(10.0, 10.0)
        thread.join()
        assert not emulator.moves
        assert emulator.opening_mm > 50.0
        assert not emulator.in_fast_stop


def test_a_stop_without_effect_becomes_a_fast_stop():
    emulator = slow()
    emulator.ignores_stop = True
    with gripper_with_emulator(emulator=emulator, max_state_age_s=0.1) as (gripper, _):
        gripper._link.begin(codec.move(10.0, 5.0))
        wait_until(lambda: emulator.moves)
        gripper.stop()
        assert not emulator.moves
        assert emulator.received.count(FAST_STOP) == 1


def test_closing_stops_moving_jaws_and_is_not_announced_while_they_may_move():
    """Without announcement the gripper stops by itself."""
    for plan in ({}, {STOP: "dropped", FAST_STOP: "dropped"}):
        emulator, script = slow(), LineFaults()
        with gripper_with_emulator(faults=script, emulator=emulator) as (gripper, _):
            gripper._link.begin(codec.move(10.0, 5.0))
            wait_until(lambda emulator=emulator: emulator.moves)
            script.tell(plan)
            gripper._link.timeout_s = 0.2 if plan else 2.0
            with pytest.raises(LinkLost, match="did not answer STOP") if plan else contextlib.nullcontext():
                gripper.close()
            assert (DISCONNECT in emulator.received) == (not plan)
            wait_until(lambda emulator=emulator: not emulator.moves)
            assert emulator.in_fast_stop == bool(plan)


@pytest.mark.parametrize(
    "use",
    [
        lambda gripper: gripper.state(),
        lambda gripper: gripper.grasp(10.0),
        lambda gripper: gripper.stop(),
        lambda gripper: gripper.recover(),
        lambda gripper: gripper.close(),
    ],
)
def test_no_call_waits_for_ever_for_a_silent_gripper(use, monkeypatch):
    monkeypatch.setattr(wsg50, "_RECONNECT_S", (0.0, 0.0))
    with gripper_with_emulator() as (gripper, emulator):
        emulator.silent, gripper._link.timeout_s = True, 0.1
        with pytest.raises(DeviceError):
            use(gripper)


def test_connecting_without_a_gripper_is_a_device_error_and_leaves_nothing_open():
    with gripper_with_emulator(connect=False, timeout_s=0.02) as (gripper, emulator):
        emulator.silent = True
        with pytest.raises(DeviceError, match="is it on and connected"):
            gripper.connect()
        with pytest.raises(LinkLost, match="it is closed"):
            gripper._link.sync()
        assert set(emulator.received) <= {0x06}  # echoes and nothing else


def test_a_disconnect_during_a_motion_ends_with_still_jaws():
    emulator, script = slow(), LineFaults()
    with gripper_with_emulator(faults=script, emulator=emulator, acknowledge_faults=True) as (gripper, _):
        script.tell({(GRASP, 2): "disconnect"})
        with pytest.raises(DeviceError, match="recover"):
            gripper.grasp(10.0, 10.0)
        wait_until(lambda: not emulator.moves)
        assert emulator.opening_mm > 50.0
        gripper.recover()
        emulator.speed_up = 20.0
        assert gripper.grasp(10.0, 100.0).status == "no_part"


def test_jaws_that_could_not_be_stopped_are_stopped_on_closing_or_closing_raises(monkeypatch):
    """A gripper that goes on without the connection, against the setting that the driver asks for."""
    emulator, script = slow(speed_up=0.1), LineFaults()
    emulator.disconnected = lambda: None

    def no_cable():
        raise LinkLost("no cable")

    with gripper_with_emulator(faults=script, emulator=emulator) as (gripper, _):
        for is_plugged_in in (True, False):
            script.tell({(GRASP, 2): "disconnect"})
            with monkeypatch.context() as cable:
                cable.setattr(gripper._link, "open", no_cable)
                with pytest.raises(DeviceError, match="was lost"):
                    gripper.grasp(10.0, 100.0)
                assert emulator.moves
                if not is_plugged_in:
                    with pytest.raises(DeviceError):
                        gripper.close()
                    assert emulator.moves
            if is_plugged_in:
                gripper.close()
                assert not emulator.moves
            gripper.connect()
            assert not emulator.moves


def test_a_grasp_that_was_refused_is_not_repeated():
    emulator = EmulatedWSG50(referenced=True, speed_up=50.0, object_mm=40.0)
    with gripper_with_emulator(emulator=emulator) as (gripper, _):
        for status in (Status.CHECKSUM_ERROR, Status.RANGE_ERROR, Status.ACCESS_DENIED):
            emulator.next_status = {GRASP: status}
            with pytest.raises(DeviceError, match=f"answered {status.name} to GRASP"):
                gripper.grasp(10.0, 400.0)
        assert emulator.received.count(GRASP) == 3


def test_the_result_of_a_stopped_motion_is_never_that_of_the_next():
    emulator = slow(object_mm=40.0)
    with gripper_with_emulator(emulator=emulator) as (gripper, _):
        gripper._link.begin(codec.command(codec.CommandId.GRASP, 0.0, 5.0))
        wait_until(lambda: emulator.moves)
        gripper.stop()  # the aborted result of the grasp has arrived, but nobody has read it
        assert gripper.grasp(10.0, 400.0).status == "holding"


def test_a_gripper_that_cannot_be_reached_is_a_lost_link():
    with pytest.raises(LinkLost, match=r"127\.0\.0\.1:1 cannot be reached: .*refused"):
        Link("127.0.0.1", 1, 0.5).open()
