"""The WSG-50's driver on a gripper in trouble: faults, silence, stops, interruptions, closing."""

import logging
import os
import signal
import socket
import threading
import time
from types import SimpleNamespace

import pytest

from robot.drivers.wsg50 import driver as wsg50
from robot.drivers.wsg50.commands import Status
from robot.drivers.wsg50.driver import WSG50
from robot.errors import DeviceError
from tests.emulators.wsg50 import gripper as wsg50_emulated
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.waiting import wait_until
from tests.wsg50_bench import (
    ACK,
    FAST_STOP,
    GRASP,
    HOME,
    PORTS,
    QUICK,
    STOP,
    TARE,
    ScriptedFaults,
    gripper_with_emulator,
)


@PORTS
def test_a_fast_stop_is_never_acknowledged_silently(port, caplog):
    with gripper_with_emulator(port, connect=False) as (gripper, emulator):
        emulator.fail("current")
        with pytest.raises(DeviceError, match=r"FAST STOP: current fault; .* acknowledge_faults"):
            gripper.connect()
        assert ACK not in emulator.received
    with gripper_with_emulator(port, connect=False, acknowledge_faults=True) as (gripper, emulator):
        emulator.fail("current")
        caplog.clear()
        gripper.connect()
        texts = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
        assert texts == ["WSG-50 is in FAST STOP: current fault", "WSG-50: FAST STOP acknowledged"]


@PORTS
def test_after_a_fast_stop_nothing_works_until_it_is_recovered(port):
    with gripper_with_emulator(port, acknowledge_faults=True) as (gripper, emulator):
        emulator.fail("temperature")
        for use in (gripper.state, lambda: gripper.open(50.0), lambda: gripper.grasp(10.0)):
            with pytest.raises(DeviceError, match=r"temperature fault.*recover\(\)"):
                use()
        emulator.lose_reference()
        gripper.recover()
        assert emulator.received.count(HOME) == 1
        assert gripper.open(50.0).status == "idle"


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("temperature warning", "temperature warning"),
        ("finger", "finger fault"),
        ("command", "command failure"),
        ("script", "script failure"),
    ],
)
def test_the_cause_of_a_fast_stop_is_named(fault, words):
    with gripper_with_emulator() as (gripper, emulator):
        emulator.fail(fault)
        with pytest.raises(DeviceError, match=f"FAST STOP: {words};"):
            gripper.state()


def test_a_warning_alone_keeps_nothing_from_working():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.warn("temperature warning")
        assert gripper.open(60.0).status == "idle"


@PORTS
def test_what_is_held_stays_held_by_its_force_when_the_program_comes_back(port):
    emulator = EmulatedWSG50(referenced=True, speed_up=20.0, object_mm=40.0)
    emulator.has_force_fingers = True
    with gripper_with_emulator(port, emulator=emulator) as (gripper, _):
        gripper.grasp(10.0)
    with gripper_with_emulator(port, emulator=emulator, tare=True) as (gripper, _):
        gripper.recover()
        assert (emulator.force_limit_n, emulator.grasping, TARE in emulator.received) == (20.0, 4, False)
        assert "something is held" in gripper.refused["tare"]
        gripper.open(60.0)
        gripper.recover()
        assert (emulator.force_limit_n, emulator.received.count(TARE), gripper.refused) == (5.0, 1, {})


NOT_HEARD = {Status.SUCCESS, Status.CMD_PENDING, Status.CHECKSUM_ERROR}


def test_a_grasp_that_is_answered_and_not_done_is_begun_again_only_where_it_was_not_heard():
    with gripper_with_emulator(
        timeout_s=0.1, emulator=EmulatedWSG50(referenced=True, speed_up=50.0, object_mm=40.0)
    ) as (
        gripper,
        emulator,
    ):
        for status in Status:
            gripper.open(60.0)
            emulator.received.clear()
            emulator.next_status = {GRASP: status}
            if status in NOT_HEARD:
                assert gripper.grasp(10.0, 400.0).status == "holding"
            else:
                with pytest.raises(DeviceError, match=f"answered {status.name} to GRASP"):
                    gripper.grasp(10.0, 400.0)
            assert emulator.received.count(GRASP) == 1 + (status in NOT_HEARD)


def test_what_was_heard_damaged_is_said_again():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.next_status = {0x33: 11, STOP: 11}
        assert gripper.settings()["force_limit_n"] == 2.5
        gripper.stop()
        assert gripper.line_counts == {"retried": 1}
        assert emulator.received.count(STOP) == 2
        assert not emulator.in_fast_stop


def test_a_lost_reference_is_said_before_anything_moves():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.lose_reference()
        with pytest.raises(DeviceError, match="reference"):
            gripper.grasp(10.0)
        assert GRASP not in emulator.received


@PORTS
def test_a_state_that_does_not_come_stops_the_motion(port):
    slow = EmulatedWSG50(referenced=True, object_mm=5.0)
    with gripper_with_emulator(port, emulator=slow, max_state_age_s=0.1) as (gripper, _):
        slow.mute_updates = True
        with pytest.raises(DeviceError, match=r"at most 0.1 s old"):
            gripper.grasp(10.0, 5.0)
        assert slow.in_fast_stop
        assert not slow.moves


def test_a_program_that_was_held_up_is_no_silent_gripper(monkeypatch):
    slow = EmulatedWSG50(referenced=True, object_mm=40.0)
    with gripper_with_emulator(emulator=slow, max_state_age_s=1.0) as (gripper, _):
        poll, waits = gripper._link.poll, [1.5]

        def held_up(command, seconds):
            status = poll(command, seconds)
            time.sleep(waits.pop() if waits else 0)
            return status

        monkeypatch.setattr(gripper._link, "poll", held_up)
        assert gripper.grasp(10.0, 100.0).status == "holding"


def test_a_fault_in_the_middle_of_a_motion_is_named():
    slow = EmulatedWSG50(referenced=True, opening_mm=100.0)
    with gripper_with_emulator(emulator=slow) as (gripper, _):
        thread = threading.Thread(target=lambda: (wait_until(lambda: slow.moves), slow.fail("current")))
        thread.start()
        with pytest.raises(DeviceError, match=r"answered CMD_ABORTED to GRASP .* current fault"):
            gripper.grasp(10.0, 10.0)
        thread.join()


def test_a_motion_that_never_ends_is_stopped(monkeypatch):
    monkeypatch.setattr(wsg50, "_SLACK_S", 0.0)
    with gripper_with_emulator() as (gripper, emulator):
        emulator.jammed = True
        with pytest.raises(DeviceError, match=r"GRASP \(25h\) in time"):
            gripper.grasp(10.0, 400.0)
        assert not emulator.moves
        assert emulator.received.count(GRASP) == 1
        emulator.jammed = False
        assert gripper.grasp(10.0).status == "no_part"


@PORTS
@pytest.mark.parametrize("call", ["grasp", "open", "home"])
def test_ctrl_c_stops_the_jaws(port, call):
    slow = EmulatedWSG50(referenced=True, opening_mm=100.0)
    uses = {"grasp": lambda g: g.grasp(10.0, 10.0), "open": lambda g: g.open(10.0), "home": lambda g: g.home()}
    with gripper_with_emulator(port, emulator=slow, opening_speed_mm_s=10.0, home_direction="in") as (gripper, _):

        def interrupt():
            wait_until(lambda: slow.moves)
            os.kill(os.getpid(), signal.SIGINT)

        thread = threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            uses[call](gripper)
        thread.join()
        assert not slow.moves
        assert not slow.is_closing
        assert slow.opening_mm > 50.0
        assert not slow.in_fast_stop  # usable: homing lost its reference, no more


def test_stop_is_always_allowed_and_becomes_a_fast_stop_if_nobody_answers():
    script = ScriptedFaults()
    with gripper_with_emulator(faults=script) as (gripper, emulator):
        gripper.stop()
        gripper.stop()
        script.tell({STOP: "dropped"})
        gripper.stop()
        assert emulator.received.count(FAST_STOP) == 1
        assert emulator.in_fast_stop


def test_a_stop_that_is_answered_and_does_nothing_becomes_a_fast_stop(monkeypatch):
    monkeypatch.setitem(wsg50_emulated._ACTIONS, STOP, lambda own, _: 0)
    slow = EmulatedWSG50(referenced=True, opening_mm=100.0)
    with gripper_with_emulator(emulator=slow, max_state_age_s=0.1) as (gripper, _):
        gripper._link.begin(wsg50.commands.move(10.0, 5.0))
        wait_until(lambda: slow.moves)
        gripper.stop()
        assert not slow.moves
        assert slow.received.count(FAST_STOP) == 1


@pytest.mark.parametrize(
    "use",
    [
        lambda g: g.state(),
        lambda g: g.settings(),
        lambda g: g.open(20.0),
        lambda g: g.grasp(10.0),
        lambda g: g.stop(),
        lambda g: g.home(),
        lambda g: g.recover(),
        lambda g: g.close(),
    ],
)
def test_no_call_waits_for_ever_for_a_gripper_that_says_nothing(use):
    with gripper_with_emulator(timeout_s=0.02, reconnect_tries=2) as (gripper, emulator):
        emulator.silent = True
        started = time.monotonic()
        with pytest.raises(DeviceError):
            use(gripper)
        assert time.monotonic() - started < 5


@pytest.mark.parametrize("use", ["state", "recover", "home", "stop", "settings"])
def test_nothing_works_before_connecting_and_after_closing(use):
    with gripper_with_emulator(connect=False) as (gripper, _):
        with pytest.raises(DeviceError, match="must be connected"):
            getattr(gripper, use)()
        gripper.connect()
        gripper.close()
        gripper.close()
        with pytest.raises(DeviceError, match="must be connected"):
            getattr(gripper, use)()
        gripper.connect()
        gripper.connect()
        assert gripper.is_connected


@PORTS
def test_closing_says_so_leaves_no_fault_and_keeps_what_is_held(port):
    with gripper_with_emulator(port) as (gripper, emulator):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        gripper.close()
        time.sleep(0.05)
        assert not emulator.in_fast_stop
        assert emulator.grasping == 4
        assert emulator.received[-1] == 0x07


def test_the_end_of_a_line_is_not_announced_while_the_jaws_may_move():
    """The gripper then stops by itself."""
    slow = EmulatedWSG50(referenced=True, opening_mm=100.0)
    script = ScriptedFaults()
    with gripper_with_emulator(faults=script, emulator=slow, timeout_s=0.1) as (gripper, _):
        gripper._link.begin(wsg50.commands.move(10.0, 5.0))
        wait_until(lambda: slow.moves)
        script.tell({STOP: "dropped", FAST_STOP: "dropped"})
        with pytest.raises(DeviceError, match="must answer FAST_STOP"):
            gripper.close()
        assert 0x07 not in slow.received
        wait_until(lambda: slow.in_fast_stop and not slow.moves)


def test_closing_stops_what_moves():
    slow = EmulatedWSG50(referenced=True, opening_mm=100.0)
    with gripper_with_emulator(emulator=slow) as (gripper, _):
        gripper._link.begin(wsg50.commands.move(10.0, 10.0))
        wait_until(lambda: slow.moves)
        gripper.close()
        assert not slow.moves
        assert not slow.in_fast_stop


def test_connecting_to_nothing_is_a_sentence_and_leaves_nothing_open():
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    gripper = WSG50(port=f"socket://127.0.0.1:{free}", **QUICK)
    with pytest.raises(DeviceError, match="cannot be opened"):
        gripper.connect()
    assert not gripper.is_connected
    with gripper_with_emulator(connect=False, timeout_s=0.02) as (gripper, emulator):
        emulator.silent = True
        with pytest.raises(DeviceError, match="is it on, and connected"):
            gripper.connect()
        assert not gripper._link.is_open
        assert not gripper.is_connected
        assert emulator.received == [0x06] * 3  # asked three times whether it is there, and left alone


def test_however_often_the_gripper_is_tried_no_wait_is_longer_than_seconds(monkeypatch):
    """Doubled each time, the last of twenty waits would take more than a day."""
    waits = []
    monkeypatch.setattr("robot.drivers.wsg50.setup.time", SimpleNamespace(sleep=waits.append))
    for first, longest in ((0.2, 5.0), (30.0, 30.0)):
        waits.clear()
        gripper = WSG50(port="/nowhere/tty", reconnect_tries=20, reconnect_s=first)
        with pytest.raises(DeviceError, match="after 20 tries"):
            gripper._setup.reconnect()
        assert (len(waits), waits[0], max(waits)) == (19, first, longest)


def test_recovering_gives_up_after_the_tries_it_was_given(caplog):
    with gripper_with_emulator(reconnect_tries=3) as (gripper, _):
        pass
    gripper._connected = True  # as if the gripper had been switched off meanwhile
    with pytest.raises(DeviceError, match="after 3 tries"):
        gripper.recover()
    assert caplog.text.count("trying again") == 2
    gripper._connected = False
