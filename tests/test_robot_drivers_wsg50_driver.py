"""The WSG-50's driver against the emulated gripper, over TCP and a terminal: each method, each fault, each way out."""

import contextlib
import json
import logging
import math
import os
import signal
import socket
import threading
import time

import pytest

from robot.drivers import wsg50, wsg50_emulated
from robot.drivers.wsg50 import WSG50
from robot.drivers.wsg50_codec import Frame, encode
from robot.drivers.wsg50_commands import Statistics
from robot.drivers.wsg50_emulator import Emulator, Faults, serve_pty, serve_tcp
from robot.drivers.wsg50_faults import KINDS, Piece
from robot.errors import DeviceError, RobotConfigError

SERVE = {"tcp": serve_tcp, "pty": serve_pty}
QUICK = {"timeout_s": 0.3, "reconnect_s": 0.01, "max_state_age_s": 0.5, "opening_speed_mm_s": 400.0}
HOME, MOVE, STOP, FAST_STOP, ACK, GRASP, RELEASE, TARE = 0x20, 0x21, 0x22, 0x23, 0x24, 0x25, 0x26, 0x38


class Script(Faults):
    """Does to the frames named by (id, number of the frame with this id) what it is told: the counting starts when
    told. Commands and replies count together: 1 the command, 2 its first reply. "after a result": a SUCCESS that is
    none comes before it."""

    def __init__(self):
        super().__init__()
        self.plan, self.seen = {}, {}

    def tell(self, plan):
        self.plan, self.seen = plan, {}

    def on(self, frame):
        self.seen[frame.id] = self.seen.get(frame.id, 0) + 1
        kind = self.plan.get((frame.id, self.seen[frame.id])) or self.plan.get(frame.id)
        plain = encode(frame)
        if kind == "after a result":
            return [Piece(encode(Frame(frame.id, bytes(2))) + plain)]
        return list(self._damaged(kind, frame, plain) if kind else [Piece(plain)])


@contextlib.contextmanager
def bench(port="tcp", faults=None, connect=True, emulator=None, **settings):
    """A driver, connected or not, and its emulated gripper."""
    emulator = emulator or Emulator(referenced=True, speed_up=20.0)
    with SERVE[port](emulator, faults) as address:
        gripper = WSG50(port=address, **QUICK | settings)
        if connect:
            gripper.connect()
        try:
            yield gripper, emulator
        finally:
            with contextlib.suppress(DeviceError):
                gripper.close()


@pytest.fixture(autouse=True)
def quick_close(monkeypatch):
    """pyserial waits 0.3 s after closing a socket."""
    import serial.urlhandler.protocol_socket as protocol

    monkeypatch.setattr(protocol, "time", type("NoWait", (), {"sleep": staticmethod(lambda _: None)}))


@pytest.fixture(params=SERVE)
def port(request):
    return request.param


def until(condition, seconds=10.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_it_grasps_holds_and_lets_go(port):
    with bench(port) as (gripper, emulator):
        emulator.object_mm = 40.0
        held = gripper.grasp(10.0, 200.0)
        assert (held.opening_mm, held.force_n, held.status) == (pytest.approx(40.0), 10.0, "holding")
        assert gripper.state() == held
        opened = gripper.open(110.0)
        assert (opened.opening_mm, opened.force_n, opened.status) == (pytest.approx(110.0), 0.0, "idle")
        assert gripper.state() == opened
        assert gripper.statistics() == Statistics(1, 0, 0)
        assert gripper.line_counts == {}


def test_a_serial_line_takes_its_rate_and_stop_bits():
    with bench("pty", baud=9600, stop_bits=2) as (gripper, _):
        assert (gripper._link._port._serial.baudrate, gripper._link._port._serial.stopbits) == (9600, 2)
        assert gripper.state().status == "idle"


def test_closing_on_nothing_is_no_part_and_is_left_by_opening_or_grasping(port):
    with bench(port) as (gripper, emulator):
        assert gripper.grasp(10.0).status == "no_part"
        assert gripper.open(60.0).status == "idle"
        assert gripper.grasp(10.0).status == "no_part"
        emulator.object_mm = 3.0
        assert gripper.grasp(10.0).status == "holding"  # released by 5 mm before: GRASP is refused in NO PART
        assert emulator.heard.count(RELEASE) == 2


def test_a_part_that_is_lost_is_said_and_left(port):
    with bench(port) as (gripper, emulator):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        emulator.object_mm = None
        assert gripper.state().status == "part_lost"
        assert gripper.open(110.0).status == "idle"


def test_grasping_what_is_held_takes_it_anew_with_the_new_force():
    with bench() as (gripper, emulator):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        assert gripper.grasp(20.0).force_n == 20.0


def test_opening_less_far_than_what_is_held_lets_go_first():
    with bench() as (gripper, emulator):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        with pytest.raises(DeviceError, match=r"AXIS_BLOCKED to MOVE .* stands at 40.0 mm"):
            gripper.open(20.0)
        assert emulator.force_limit_n == 5.0  # the least: it only meant to open
        emulator.object_mm = None
        assert gripper.open(20.0).opening_mm == pytest.approx(20.0)


def test_force_is_that_on_each_finger_and_twice_as_much_for_the_gripper():
    with bench(max_force_n=30.0) as (gripper, emulator):
        assert (gripper.min_force_n, gripper.max_force_n) == (2.5, 30.0)
        emulator.object_mm = 40.0
        assert gripper.grasp(12.5).force_n == 12.5
        assert emulator.force_limit_n == 25.0
        assert gripper.settings()["force_limit_n"] == 12.5
    with bench(finger_share=1.0, max_force_n=300.0) as (gripper, emulator):
        assert (gripper.min_force_n, gripper.max_force_n) == (5.0, 80.0)
        gripper.grasp(12.5)
        assert emulator.force_limit_n == 12.5


def test_what_is_out_of_range_never_reaches_the_gripper():
    with bench(max_force_n=30.0, max_speed_mm_s=300.0) as (gripper, emulator):
        emulator.heard.clear()
        for misuse in (
            lambda: gripper.grasp(2.4),
            lambda: gripper.grasp(30.1),
            lambda: gripper.grasp(math.nan),
            lambda: gripper.grasp(10.0, 4.9),
            lambda: gripper.grasp(10.0, 301.0),
            lambda: gripper.open(-0.1),
            lambda: gripper.open(110.1),
        ):
            with pytest.raises(DeviceError, match="must be from"):
                misuse()
        assert set(emulator.heard) <= {STOP, 0x06, 0x40, 0x41, 0x43, 0x44, 0x45}  # reads, and the stop after a refusal
        for misuse in (
            lambda: gripper.set_acceleration(5001.0),
            lambda: gripper.set_soft_limits(50.0, 111.0),
            lambda: gripper.set_soft_limits(50.0, 40.0),
        ):
            with pytest.raises(DeviceError, match="must be from"):
                misuse()
        assert not {0x30, 0x34} & set(emulator.heard)


def test_a_gripper_that_would_clamp_harder_than_asked_is_not_told_to():
    with bench() as (gripper, emulator):
        emulator.keeps_force_n = 60.0
        with pytest.raises(DeviceError, match="force limit must be 20 N, the gripper has 60 N"):
            gripper.grasp(10.0)
        assert GRASP not in emulator.heard
        assert gripper.refused["force_n"] == "asked 10, has 30"
        emulator.keeps_force_n = 16.0
        gripper.grasp(10.0)
        assert gripper.refused["force_n"] == "asked 10, has 8"
        emulator.keeps_force_n = None
        gripper.grasp(10.0)
        assert gripper.refused == {}


def test_it_homes_on_connecting_where_the_reference_is_lost(port, caplog):
    with bench(port, emulator=Emulator(speed_up=20.0)) as (gripper, emulator):
        assert emulator.heard.count(HOME) == 1
        assert "homing, the jaws move" in caplog.text
        assert gripper.state().opening_mm == pytest.approx(110.0)
        assert gripper.home().status == "idle"
    with bench(home_direction="in", emulator=Emulator(speed_up=20.0)) as (gripper, _):
        assert gripper.state().opening_mm == pytest.approx(0.0)


def test_settings_are_written_read_back_and_plain():
    with bench(acceleration_mm_s2=1500.0, soft_limits_mm=[5.0, 90.0], tare=True) as (gripper, emulator):
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
        gripper.clear_soft_limits()
        assert gripper.stroke_mm == 110.0
        assert gripper.settings()["soft_limits_mm"] is None
        assert gripper.set_soft_limits(0.0, 100.0) == (0.0, 100.0)
        assert gripper.set_acceleration(200.0) == 200.0
        assert emulator.soft_limits == (0.0, 100.0)


def test_small_questions_are_answered():
    with bench() as (gripper, emulator):
        assert gripper.info().serial == 20260101
        assert gripper.speed() == 0.0
        with pytest.raises(DeviceError, match="NOT_AVAILABLE"):
            gripper.tare()
        emulator.has_force_fingers = True
        gripper.tare()
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        tared = emulator.heard.count(TARE)
        with pytest.raises(DeviceError, match="nothing may be held"):
            gripper.tare()
        assert emulator.heard.count(TARE) == tared


def test_what_is_held_thinner_than_a_part_is_the_other_finger():
    with bench(least_part_mm=5.0) as (gripper, emulator):
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
    ],
)
def test_a_setting_out_of_range_is_refused(settings):
    with pytest.raises(RobotConfigError, match="must"):
        WSG50(port="loop://", **settings)


@pytest.mark.parametrize("settings", [{"max_force_n": 2.0}, {"max_speed_mm_s": 4.0}])
def test_ceilings_below_what_it_can_do_are_refused_on_connecting(settings):
    with bench(connect=False, **settings) as (gripper, emulator):
        with pytest.raises(RobotConfigError, match="ceilings must allow"):
            gripper.connect()
        assert not gripper.is_connected
        assert not emulator.in_fast_stop


# What goes wrong in the gripper.


def test_a_fast_stop_is_never_acknowledged_silently(port, caplog):
    with bench(port, connect=False) as (gripper, emulator):
        emulator.fail("current")
        with pytest.raises(DeviceError, match=r"FAST STOP: current fault; .* acknowledge_faults"):
            gripper.connect()
        assert ACK not in emulator.heard
    with bench(port, connect=False, acknowledge_faults=True) as (gripper, emulator):
        emulator.fail("current")
        caplog.clear()
        gripper.connect()
        texts = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
        assert texts == ["WSG-50 is in FAST STOP: current fault", "WSG-50: FAST STOP acknowledged"]


def test_after_a_fast_stop_nothing_works_until_it_is_recovered(port):
    with bench(port, acknowledge_faults=True) as (gripper, emulator):
        emulator.fail("temperature")
        for use in (gripper.state, lambda: gripper.open(50.0), lambda: gripper.grasp(10.0)):
            with pytest.raises(DeviceError, match=r"temperature fault.*recover\(\)"):
                use()
        emulator.lose_reference()
        gripper.recover()
        assert emulator.heard.count(HOME) == 1
        assert gripper.open(50.0).status == "idle"


def test_a_lost_reference_is_said_before_anything_moves():
    with bench() as (gripper, emulator):
        emulator.lose_reference()
        with pytest.raises(DeviceError, match="reference"):
            gripper.grasp(10.0)
        assert GRASP not in emulator.heard


def test_a_state_that_does_not_come_stops_the_motion(port):
    slow = Emulator(referenced=True, object_mm=5.0)
    with bench(port, emulator=slow, max_state_age_s=0.1) as (gripper, _):
        slow.mute_updates = True
        with pytest.raises(DeviceError, match=r"at most 0.1 s old"):
            gripper.grasp(10.0, 5.0)
        assert slow.in_fast_stop
        assert not slow.moves


def test_a_program_that_was_held_up_is_no_silent_gripper(monkeypatch):
    slow = Emulator(referenced=True, object_mm=40.0)
    with bench(emulator=slow, max_state_age_s=0.1) as (gripper, _):
        poll, waits = gripper._link.poll, [0.3]

        def held_up(command, seconds):
            status = poll(command, seconds)
            time.sleep(waits.pop() if waits else 0)
            return status

        monkeypatch.setattr(gripper._link, "poll", held_up)
        assert gripper.grasp(10.0, 100.0).status == "holding"


def test_a_fault_in_the_middle_of_a_motion_is_named():
    slow = Emulator(referenced=True, opening_mm=100.0)
    with bench(emulator=slow) as (gripper, _):
        thread = threading.Thread(target=lambda: (until(lambda: slow.moves), slow.fail("current")))
        thread.start()
        with pytest.raises(DeviceError, match=r"answered CMD_ABORTED to GRASP .* current fault"):
            gripper.grasp(10.0, 10.0)
        thread.join()


def test_a_motion_that_never_ends_is_stopped(monkeypatch):
    monkeypatch.setattr(wsg50, "_SLACK_S", 0.0)
    with bench() as (gripper, emulator):
        emulator.jammed = True
        with pytest.raises(DeviceError, match=r"GRASP \(25h\) in time"):
            gripper.grasp(10.0, 400.0)
        assert not emulator.moves
        assert emulator.heard.count(GRASP) == 1
        emulator.jammed = False
        assert gripper.grasp(10.0).status == "no_part"


@pytest.mark.parametrize("call", ["grasp", "open", "home"])
def test_ctrl_c_stops_the_jaws(port, call):
    slow = Emulator(referenced=True, opening_mm=100.0)
    uses = {"grasp": lambda g: g.grasp(10.0, 10.0), "open": lambda g: g.open(10.0), "home": lambda g: g.home()}
    with bench(port, emulator=slow, opening_speed_mm_s=10.0, home_direction="in") as (gripper, _):

        def interrupt():
            until(lambda: slow.moves)
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
    script = Script()
    with bench(faults=script) as (gripper, emulator):
        gripper.stop()
        gripper.stop()
        script.tell({STOP: "dropped"})
        gripper.stop()
        assert emulator.heard.count(FAST_STOP) == 1
        assert emulator.in_fast_stop


def test_a_stop_that_is_answered_and_does_nothing_becomes_a_fast_stop(monkeypatch):
    monkeypatch.setitem(wsg50_emulated._ACTIONS, STOP, lambda own, _: 0)
    slow = Emulator(referenced=True, opening_mm=100.0)
    with bench(emulator=slow, max_state_age_s=0.1) as (gripper, _):
        gripper._link.begin(wsg50.commands.move(10.0, 5.0))
        until(lambda: slow.moves)
        gripper.stop()
        assert not slow.moves
        assert slow.heard.count(FAST_STOP) == 1


@pytest.mark.parametrize(
    "use",
    [
        lambda g: g.state(),
        lambda g: g.settings(),
        lambda g: g.open(20.0),
        lambda g: g.grasp(10.0),
        lambda g: g.stop(),
        lambda g: g.home(),
        lambda g: g.tare(),
        lambda g: g.set_acceleration(500.0),
        lambda g: g.set_soft_limits(0.0, 90.0),
        lambda g: g.clear_soft_limits(),
        lambda g: g.statistics(),
        lambda g: g.info(),
        lambda g: g.speed(),
        lambda g: g.recover(),
        lambda g: g.close(),
    ],
)
def test_no_call_waits_for_ever_for_a_gripper_that_says_nothing(use):
    with bench(timeout_s=0.02, reconnect_tries=2) as (gripper, emulator):
        emulator.silent = True
        started = time.monotonic()
        with pytest.raises(DeviceError):
            use(gripper)
        assert time.monotonic() - started < 5


@pytest.mark.parametrize("use", ["state", "statistics", "recover", "home", "info", "stop", "settings"])
def test_nothing_works_before_connecting_and_after_closing(use):
    with bench(connect=False) as (gripper, _):
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


def test_closing_says_so_leaves_no_fault_and_keeps_what_is_held(port):
    with bench(port) as (gripper, emulator):
        emulator.object_mm = 40.0
        gripper.grasp(10.0)
        gripper.close()
        time.sleep(0.05)
        assert not emulator.in_fast_stop
        assert emulator.grasping == 4
        assert emulator.heard[-1] == 0x07


def test_closing_stops_what_moves():
    slow = Emulator(referenced=True, opening_mm=100.0)
    with bench(emulator=slow) as (gripper, _):
        gripper._link.begin(wsg50.commands.move(10.0, 10.0))
        until(lambda: slow.moves)
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
    with bench(connect=False, timeout_s=0.02) as (gripper, emulator):
        emulator.silent = True
        with pytest.raises(DeviceError, match="is it on, and connected"):
            gripper.connect()
        assert not gripper._link.is_open
        assert not gripper.is_connected


def test_recovering_gives_up_after_the_tries_it_was_given(caplog):
    with bench(reconnect_tries=3) as (gripper, _):
        pass
    gripper._connected = True  # as if the gripper had been switched off meanwhile
    with pytest.raises(DeviceError, match="after 3 tries"):
        gripper.recover()
    assert caplog.text.count("trying again") == 2
    gripper._connected = False


# What goes wrong on the line.


def test_a_line_that_is_cut_while_it_closes_ends_with_the_jaws_standing(port):
    slow = Emulator(referenced=True, opening_mm=100.0)
    script = Script()
    with bench(port, faults=script, emulator=slow, acknowledge_faults=True) as (gripper, _):
        script.tell({(GRASP, 2): "disconnect"})
        with pytest.raises(DeviceError, match="recover"):
            gripper.grasp(10.0, 10.0)
        until(lambda: not slow.moves)
        assert not slow.is_closing
        assert slow.opening_mm > 50.0
        gripper.recover()
        slow.speed_up = 20.0
        assert gripper.grasp(10.0, 100.0).status == "no_part"


@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_grasp_is_done_once_whatever_of_it_is_lost(port, number):
    """1 the command, 2 that it is pending, 3 its result."""
    script = Script()
    with bench(port, faults=script) as (gripper, emulator):
        emulator.object_mm = 40.0
        script.tell({(GRASP, number): "dropped"})
        assert gripper.grasp(10.0, 200.0).status == "holding"
        assert emulator.heard.count(GRASP) == 1
        assert gripper.statistics().grasps == 1
        assert gripper.line_counts.get("sent again", 0) == (number == 1)


@pytest.mark.parametrize("kind", ["dropped", "duplicated", "corrupted", "delayed", "split", "wrong id"])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_opening_ends_where_it_was_told_whatever_happens_to_a_frame(kind, number):
    script = Script()
    with bench(faults=script) as (gripper, emulator):
        for opening in (20.0, 80.0):
            script.tell({(MOVE, number): kind})
            assert gripper.open(opening).opening_mm == pytest.approx(opening, abs=0.1)
        assert not emulator.moves


def test_a_result_that_comes_twice_does_not_end_the_next_motion():
    script = Script()
    slow = Emulator(referenced=True, opening_mm=50.0)
    with bench(faults=script, emulator=slow, opening_speed_mm_s=100.0) as (gripper, _):
        script.tell({(MOVE, 3): "duplicated"})
        gripper.open(60.0)
        state = gripper.open(40.0)
        assert state.status == "idle"
        assert state.opening_mm == pytest.approx(40.0, abs=0.1)


def test_a_result_that_is_none_is_not_believed_while_the_jaws_move():
    script = Script()
    slow = Emulator(referenced=True, opening_mm=50.0)
    with bench(faults=script, emulator=slow, opening_speed_mm_s=50.0) as (gripper, _):
        script.tell({(MOVE, 2): "after a result"})
        assert gripper.open(40.0).opening_mm == pytest.approx(40.0, abs=0.1)
        assert not slow.moves
        assert slow.heard.count(MOVE) == 1


def test_every_reading_that_is_lost_is_asked_again():
    script = Script()
    with bench(faults=script) as (gripper, _):
        script.tell({(command, 2): "dropped" for command in (0x33, 0x35, 0x31, 0x50, 0x53)})
        assert gripper.settings()["limits"]["stroke_mm"] == 110.0
        assert gripper.line_counts["asked again"] == 5


@pytest.mark.parametrize("kind", KINDS)
def test_grasps_over_a_bad_line_end_right_or_with_a_reason_and_never_closing(port, kind):
    faults = Faults(0.0, [kind], seed=7, delay_s=0.02)
    emulator = Emulator(referenced=True, speed_up=40.0)
    settings = {"timeout_s": 0.1, "acknowledge_faults": True, "update_ms": 10}
    with bench(port, faults=faults, emulator=emulator, **settings) as (gripper, _):
        faults.rate = 0.005 if kind == "disconnect" else 0.02
        for number in range(6):
            emulator.object_mm, want = (40.0, "holding") if number % 2 else (None, "no_part")
            for _ in range(10):
                try:
                    gripper.open(110.0)
                    assert gripper.grasp(10.0, 300.0).status == want
                    break
                except DeviceError:
                    until(lambda: not emulator.is_closing)
                    with contextlib.suppress(DeviceError):
                        gripper.recover()
            else:
                pytest.fail(f"ten tries, {faults.counts}")
        faults.rate = 0.0


def test_pieces_of_the_script_are_those_of_the_faults():
    script = Script()
    script.tell({STOP: "disconnect"})
    assert list(script.on(wsg50.commands.stop())) == [Piece(None)]
