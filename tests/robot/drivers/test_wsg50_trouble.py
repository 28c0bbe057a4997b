"""The WSG-50's driver with a failing gripper: faults, silence, stops, interruptions, closing."""

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
def test_after_a_fast_stop_every_call_raises_until_recovery(port):
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
    ("fault", "text"),
    [
        ("temperature warning", "temperature warning"),
        ("finger", "finger fault"),
        ("command", "command failure"),
        ("script", "script failure"),
    ],
)
def test_the_cause_of_a_fast_stop_is_named(fault, text):
    with gripper_with_emulator() as (gripper, emulator):
        emulator.fail(fault)
        with pytest.raises(DeviceError, match=f"FAST STOP or in an error state: {text};"):
            gripper.state()


def test_a_warning_alone_does_not_prevent_motions():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.warn("temperature warning")
        assert gripper.open(60.0).status == "idle"


@PORTS
def test_a_held_object_keeps_its_force_when_the_program_reconnects(port):
    emulator = EmulatedWSG50(referenced=True, speed_up=20.0, object_mm=40.0)
    emulator.has_force_fingers = True
    with gripper_with_emulator(port, emulator=emulator) as (gripper, _):
        gripper.grasp(10.0)
    with gripper_with_emulator(port, emulator=emulator, tare=True) as (gripper, _):
        gripper.recover()
        assert (emulator.force_limit_n, emulator.grasping, TARE in emulator.received) == (20.0, 4, False)
        assert "an object is held" in gripper.refused["tare"]
        gripper.open(60.0)
        gripper.recover()
        assert (emulator.force_limit_n, emulator.received.count(TARE), gripper.refused) == (5.0, 1, {})


NOT_RECEIVED = {Status.SUCCESS, Status.CMD_PENDING, Status.CHECKSUM_ERROR}


def test_an_answered_grasp_that_was_not_executed_is_resent_only_if_it_was_not_received():
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
            if status in NOT_RECEIVED:
                assert gripper.grasp(10.0, 400.0).status == "holding"
            else:
                with pytest.raises(DeviceError, match=f"answered {status.name} to GRASP"):
                    gripper.grasp(10.0, 400.0)
            assert emulator.received.count(GRASP) == 1 + (status in NOT_RECEIVED)


def test_commands_received_damaged_are_repeated():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.next_status = {0x33: 11, STOP: 11}
        assert gripper.settings()["force_limit_n"] == 2.5
        gripper.stop()
        assert gripper.line_counts == {"retried": 1}
        assert emulator.received.count(STOP) == 2
        assert not emulator.in_fast_stop


def test_a_lost_reference_raises_before_any_motion():
    with gripper_with_emulator() as (gripper, emulator):
        emulator.lose_reference()
        with pytest.raises(DeviceError, match="reference"):
            gripper.grasp(10.0)
        assert GRASP not in emulator.received


@PORTS
def test_missing_state_updates_stop_the_motion(port):
    slow = EmulatedWSG50(referenced=True, object_mm=5.0)
    with gripper_with_emulator(port, emulator=slow, max_state_age_s=0.1) as (gripper, _):
        slow.mute_updates = True
        with pytest.raises(DeviceError, match=r"at most 0.1 s old"):
            gripper.grasp(10.0, 5.0)
        assert slow.in_fast_stop
        assert not slow.moves


def test_a_suspended_program_does_not_count_as_a_silent_gripper(monkeypatch):
    slow = EmulatedWSG50(referenced=True, object_mm=40.0)
    with gripper_with_emulator(emulator=slow, max_state_age_s=1.0) as (gripper, _):
        poll, waits = gripper._link.poll, [1.5]

        def suspended(command, seconds):
            status = poll(command, seconds)
            time.sleep(waits.pop() if waits else 0)
            return status

        monkeypatch.setattr(gripper._link, "poll", suspended)
        assert gripper.grasp(10.0, 100.0).status == "holding"


def test_a_fault_during_a_motion_is_named():
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
        with pytest.raises(DeviceError, match=r"did not end GRASP \(25h\) in time"):
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
        assert not slow.in_fast_stop  # usable, except that interrupted homing has lost the reference


def test_stop_is_always_allowed_and_becomes_a_fast_stop_without_an_answer():
    script = ScriptedFaults()
    with gripper_with_emulator(faults=script) as (gripper, emulator):
        gripper.stop()
        gripper.stop()
        script.tell({STOP: "dropped"})
        gripper.stop()
        assert emulator.received.count(FAST_STOP) == 1
        assert emulator.in_fast_stop


def test_an_answered_stop_without_effect_becomes_a_fast_stop(monkeypatch):
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
def test_no_call_waits_for_ever_for_a_silent_gripper(use):
    with gripper_with_emulator(timeout_s=0.02, reconnect_tries=2) as (gripper, emulator):
        emulator.silent = True
        started = time.monotonic()
        with pytest.raises(DeviceError):
            use(gripper)
        assert time.monotonic() - started < 5


@pytest.mark.parametrize("use", ["state", "recover", "home", "stop", "settings"])
def test_every_call_raises_before_connecting_and_after_closing(use):
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
def test_closing_is_announced_leaves_no_fault_and_keeps_a_held_object(port):
    with gripper_with_emulator(port) as (gripper, emulator):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        gripper.close()
        time.sleep(0.05)
        assert not emulator.in_fast_stop
        assert emulator.grasping == 4
        assert emulator.received[-1] == 0x07


def test_the_disconnect_is_not_announced_while_the_jaws_may_move():
    """Without announcement the gripper stops by itself."""
    slow = EmulatedWSG50(referenced=True, opening_mm=100.0)
    script = ScriptedFaults()
    with gripper_with_emulator(faults=script, emulator=slow, timeout_s=0.1) as (gripper, _):
        gripper._link.begin(wsg50.commands.move(10.0, 5.0))
        wait_until(lambda: slow.moves)
        script.tell({STOP: "dropped", FAST_STOP: "dropped"})
        with pytest.raises(DeviceError, match="did not answer FAST_STOP"):
            gripper.close()
        assert 0x07 not in slow.received
        wait_until(lambda: slow.in_fast_stop and not slow.moves)


def test_closing_stops_moving_jaws():
    slow = EmulatedWSG50(referenced=True, opening_mm=100.0)
    with gripper_with_emulator(emulator=slow) as (gripper, _):
        gripper._link.begin(wsg50.commands.move(10.0, 10.0))
        wait_until(lambda: slow.moves)
        gripper.close()
        assert not slow.moves
        assert not slow.in_fast_stop


def test_connecting_to_a_closed_port_is_a_device_error_and_leaves_nothing_open():
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    gripper = WSG50(port=f"socket://127.0.0.1:{free}", **QUICK)
    with pytest.raises(DeviceError, match="cannot be opened"):
        gripper.connect()
    assert not gripper.is_connected
    with gripper_with_emulator(connect=False, timeout_s=0.02) as (gripper, emulator):
        emulator.silent = True
        with pytest.raises(DeviceError, match="is it on and connected"):
            gripper.connect()
        assert not gripper._link.is_open
        assert not gripper.is_connected
        assert emulator.received == [0x06] * 3  # three tries of an echo and nothing else


def test_the_waits_between_tries_are_limited_to_seconds(monkeypatch):
    """Without a limit, the last of twenty doubled waits would take more than a day."""
    waits = []
    monkeypatch.setattr("robot.drivers.wsg50.setup.time", SimpleNamespace(sleep=waits.append))
    for first, longest in ((0.2, 5.0), (30.0, 30.0)):
        waits.clear()
        gripper = WSG50(port="/nowhere/tty", reconnect_tries=20, reconnect_s=first)
        with pytest.raises(DeviceError, match="after 20 tries"):
            gripper._setup.reconnect()
        assert (len(waits), waits[0], max(waits)) == (19, first, longest)


def test_recovery_raises_after_the_last_try(caplog):
    with gripper_with_emulator(reconnect_tries=3) as (gripper, _):
        pass
    gripper._connected = True  # as if the gripper were switched off
    with pytest.raises(DeviceError, match="after 3 tries"):
        gripper.recover()
    assert caplog.text.count("trying again") == 2
    gripper._connected = False
