"""The WSG-50's driver on a link that loses, doubles, damages and delays packets, and that disconnects."""

import contextlib
import time

import pytest

from robot.drivers.wsg50 import driver as wsg50
from robot.drivers.wsg50.link import LinkLost
from robot.errors import DeviceError
from tests.emulators.wsg50.faults import LineFaults
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.waiting import wait_until
from tests.wsg50_bench import FAST_STOP, GRASP, HOME, MOVE, PORTS, STOP, ScriptedFaults, gripper_with_emulator


@PORTS
def test_a_disconnect_while_closing_ends_with_still_jaws(port):
    slow = EmulatedWSG50(referenced=True, opening_mm=100.0)
    script = ScriptedFaults()
    with gripper_with_emulator(port, faults=script, emulator=slow, acknowledge_faults=True) as (gripper, _):
        script.tell({(GRASP, 2): "disconnect"})
        with pytest.raises(DeviceError, match="recover"):
            gripper.grasp(10.0, 10.0)
        wait_until(lambda: not slow.moves)
        assert not slow.is_closing
        assert slow.opening_mm > 50.0
        gripper.recover()
        slow.speed_up = 20.0
        assert gripper.grasp(10.0, 100.0).status == "no_part"


def test_a_serial_line_lost_during_homing_is_opened_again_to_stop_the_jaws():
    slow = EmulatedWSG50(speed_up=0.1)
    script = ScriptedFaults()
    with gripper_with_emulator("pty", faults=script, emulator=slow, connect=False) as (gripper, _):
        script.tell({(HOME, 2): "disconnect"})
        with pytest.raises(DeviceError, match=r"was lost.*recover"):
            gripper.connect()
        assert HOME in slow.received
        assert not slow.moves
        assert not gripper._link.is_open


def test_jaws_that_could_not_be_stopped_are_stopped_on_closing_or_closing_raises(monkeypatch):
    slow = EmulatedWSG50(referenced=True, opening_mm=100.0, speed_up=0.1)
    script = ScriptedFaults()

    def no_cable():
        raise LinkLost("no cable")

    with gripper_with_emulator("pty", faults=script, emulator=slow, reconnect_tries=2) as (gripper, _):
        for back in (True, False):
            script.tell({(GRASP, 2): "disconnect"})
            with monkeypatch.context() as cable:
                cable.setattr(gripper._link, "open", no_cable)
                with pytest.raises(DeviceError, match="was lost"):
                    gripper.grasp(10.0, 100.0)
                assert slow.moves
                if not back:
                    with pytest.raises(DeviceError, match="is closed or was lost"):
                        gripper.close()
                    assert slow.moves
            if back:
                gripper.close()
                assert not slow.moves
            gripper.connect()
            assert not slow.moves
        slow.received.clear()
        gripper.close()
        assert STOP not in slow.received


@PORTS
def test_a_stop_with_a_damaged_length_does_not_swallow_the_next(port):
    slow = EmulatedWSG50(referenced=True, opening_mm=100.0)
    script = ScriptedFaults()
    with gripper_with_emulator(port, faults=script, emulator=slow, timeout_s=0.1) as (gripper, _):
        gripper._link.begin(wsg50.commands.move(10.0, 5.0))
        wait_until(lambda: slow.moves)
        script.tell({(STOP, 1): "long"})
        gripper.stop()
        assert not slow.moves
        assert STOP in slow.received
        assert FAST_STOP not in slow.received


def test_an_echo_with_a_damaged_length_does_not_swallow_the_next():
    script = ScriptedFaults()
    with gripper_with_emulator(faults=script, timeout_s=0.1) as (gripper, _):
        gripper._link.require_sync()
        script.tell({(0x06, 1): "long"})
        gripper.state()
        assert gripper.line_counts["no echo"] == 1


def test_homing_with_a_lost_result_is_not_repeated():
    script = ScriptedFaults()
    with gripper_with_emulator(faults=script, emulator=EmulatedWSG50(speed_up=2.0), connect=False) as (
        gripper,
        emulator,
    ):
        script.tell({(HOME, 3): "dropped"})
        gripper.connect()
        assert emulator.received.count(HOME) == 1
        emulator.received.clear()
        script.tell({(HOME, 3): "dropped"})
        gripper.open(60.0)
        assert gripper.home().opening_mm == pytest.approx(110.0)
        assert emulator.received.count(HOME) == 1


def test_a_command_that_was_received_damaged_is_resent_at_once():
    script = ScriptedFaults()
    with gripper_with_emulator(faults=script, timeout_s=30.0) as (gripper, emulator):
        emulator.answers_bad_checksum, emulator.object_mm = True, 40.0
        script.tell({(GRASP, 1): "bad sum", (0x32, 1): "bad sum", (0x40, 1): "bad sum"})
        started = time.monotonic()
        assert gripper.grasp(10.0).status == "holding"
        assert time.monotonic() - started < 25  # less than the time-out
        assert emulator.received.count(GRASP) == 1
        assert gripper.line_counts == {"retried": 2, "resent": 1}


@PORTS
@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_grasp_is_executed_once_whichever_of_its_packets_is_lost(port, number):
    """The packets are 1 the command, 2 the pending reply, 3 the result."""
    script = ScriptedFaults()
    with gripper_with_emulator(port, faults=script) as (gripper, emulator):
        emulator.object_mm = 40.0
        script.tell({(GRASP, number): "dropped"})
        assert gripper.grasp(10.0, 200.0).status == "holding"
        assert emulator.received.count(GRASP) == 1
        assert gripper.line_counts.get("resent", 0) == (number == 1)


@pytest.mark.parametrize("kind", ["dropped", "duplicated", "corrupted", "delayed", "split", "wrong id"])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_opening_reaches_its_target_with_any_fault_of_a_packet(kind, number):
    script = ScriptedFaults()
    with gripper_with_emulator(faults=script) as (gripper, emulator):
        for opening in (20.0, 80.0):
            script.tell({(MOVE, number): kind})
            assert gripper.open(opening).opening_mm == pytest.approx(opening, abs=0.1)
        assert not emulator.moves


def test_a_doubled_result_does_not_end_the_next_motion():
    script = ScriptedFaults()
    slow = EmulatedWSG50(referenced=True, opening_mm=50.0)
    with gripper_with_emulator(faults=script, emulator=slow, opening_speed_mm_s=100.0) as (gripper, _):
        script.tell({(MOVE, 3): "duplicated"})
        gripper.open(60.0)
        state = gripper.open(40.0)
        assert state.status == "idle"
        assert state.opening_mm == pytest.approx(40.0, abs=0.1)


def test_a_false_result_does_not_end_a_motion():
    script = ScriptedFaults()
    slow = EmulatedWSG50(referenced=True, opening_mm=50.0)
    with gripper_with_emulator(faults=script, emulator=slow, opening_speed_mm_s=50.0) as (gripper, _):
        script.tell({(MOVE, 2): "after a result"})
        assert gripper.open(40.0).opening_mm == pytest.approx(40.0, abs=0.1)
        assert not slow.moves
        assert slow.received.count(MOVE) == 1


def test_every_lost_reading_is_repeated():
    script = ScriptedFaults()
    with gripper_with_emulator(faults=script) as (gripper, _):
        script.tell({(command, 2): "dropped" for command in (0x33, 0x35, 0x31, 0x50, 0x53)})
        assert gripper.settings()["limits"]["stroke_mm"] == 110.0
        assert gripper.line_counts["retried"] == 5


@PORTS
@pytest.mark.parametrize("kind", LineFaults.KINDS)
def test_grasps_over_a_bad_link_succeed_or_raise_and_never_leave_the_jaws_closing(port, kind):
    faults = LineFaults(0.0, [kind], seed=7, delay_s=0.02)
    emulator = EmulatedWSG50(referenced=True, speed_up=40.0)
    settings = {"timeout_s": 0.1, "acknowledge_faults": True, "update_ms": 10}
    with gripper_with_emulator(port, faults=faults, emulator=emulator, **settings) as (gripper, _):
        faults.rate = 0.005 if kind == "disconnect" else 0.02
        for number in range(6):
            emulator.object_mm, expected = (40.0, "holding") if number % 2 else (None, "no_part")
            for _ in range(10):
                try:
                    gripper.open(110.0)
                    assert gripper.grasp(10.0, 300.0).status == expected
                    break
                except DeviceError:
                    wait_until(lambda: not emulator.is_closing)
                    with contextlib.suppress(DeviceError):
                        gripper.recover()
            else:
                pytest.fail(f"ten tries, {faults.counts}")
        faults.rate = 0.0
