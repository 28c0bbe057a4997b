"""The WSG-50 parallel gripper (Weiss Robotics, SCHUNK) as a Gripper of the contract.

Commands of its binary interface over a serial port or TCP: robot.drivers.wsg50.commands; the line: wsg50_link; how it
is set up: wsg50_setup; how a motion is watched: wsg50_motion; what its forces are: wsg50_force. Tried against
wsg50_emulator, not yet on a gripper.

Before use set in the gripper's web page: binary command interface; "part width tolerance" and "clamping travel" at
their greatest, since the width of what is grasped is not known beforehand (a note in the Robotics Library's driver);
"error state on TCP disconnect" left on, since then the jaws stop when this program dies; over a serial line they do
not.
"""

import logging
import time
from collections.abc import Sequence
from typing import Any

from robot.devices import Clock, Gripper
from robot.drivers.wsg50 import commands
from robot.drivers.wsg50.codec import Packet
from robot.drivers.wsg50.commands import Command, GraspingState, Info, Statistics, Status, SystemState
from robot.drivers.wsg50.force import FINGER_SHARE, on_finger
from robot.drivers.wsg50.link import NoReply
from robot.drivers.wsg50.motion import Done, Reading, causes, check_ready, read
from robot.drivers.wsg50.port import LinkLost
from robot.drivers.wsg50.setup import TYPICAL, Settings, Setup, first_failure
from robot.errors import DeviceError
from robot.readings import GripperState
from robot.readings import Status as Word

_log = logging.getLogger(__name__)
_WORDS: dict[GraspingState, Word] = {
    GraspingState.IDLE: "idle",
    GraspingState.GRASPING: "moving",
    GraspingState.NO_PART: "no_part",
    GraspingState.PART_LOST: "part_lost",
    GraspingState.HOLDING: "holding",
    GraspingState.RELEASING: "moving",
    GraspingState.POSITIONING: "moving",
}
_CLOSED_ON = {GraspingState.HOLDING, GraspingState.NO_PART, GraspingState.PART_LOST}
"""States that only RELEASE leaves; GRASP is refused in them."""

_REACHED_MM, _SAME_MM = 1.0, 0.1
"""A motion has arrived so near its target; nearer than the second it need not be begun."""

_REGRIP_MM = 5.0
"""So far are the jaws opened to let go of what they hold before they grasp again."""

_SLACK_S = 2.0
"""What a motion may take beyond its way at its speed, for acceleration and the line."""


class WSG50(Gripper):
    """A WSG-50 at `port`: a path, or socket://192.168.1.20:1000. Forces are those on each finger (wsg50_force).

    baud, stop_bits: of a serial line, as set in the gripper (the defaults are not verified). timeout_s: of an answer.
    home_direction: "default" as the gripper is configured, "out" or "in"; it is homed on connecting if it has lost its
    reference. acceleration_mm_s2: 0 leaves the gripper's own; soft_limits_mm: least and greatest opening, empty leaves
    its own. tare: the force-measuring fingers on connecting. acknowledge_faults: end a FAST STOP that is found, after
    saying it aloud; else a person must. grasp_width_mm: nominal width given with each grasp. least_part_mm: what is
    held at less is the other finger, not a part. finger_share: see wsg50_force. update_ms: period of the state while
    it moves, which must not be older than max_state_age_s. reconnect_tries, reconnect_s: how often `recover` opens the
    port again, and the first wait (s), which doubles up to 5 s. max_force_n, max_speed_mm_s: ceilings.

    `stop` lets go of what is held, since STOP ends the gripper's force control. For one thread: to stop it from
    outside, interrupt that thread (Ctrl-C).

    Raises RobotConfigError for a setting out of range.
    """

    def __init__(
        self,
        *,
        port: str,
        baud: int = 115200,
        stop_bits: int = 1,
        timeout_s: float = 1.0,
        home_direction: str = "default",
        acceleration_mm_s2: float = 0.0,
        soft_limits_mm: Sequence[float] = (),
        tare: bool = False,
        acknowledge_faults: bool = False,
        grasp_width_mm: float = 0.0,
        least_part_mm: float = 1.0,
        opening_speed_mm_s: float = 80.0,
        finger_share: float = FINGER_SHARE,
        update_ms: int = 20,
        homing_timeout_s: float = 30.0,
        reconnect_tries: int = 5,
        reconnect_s: float = 0.2,
        max_force_n: float = 40.0,
        max_speed_mm_s: float = 420.0,
        max_state_age_s: float = 0.5,
        clock: Clock = time.monotonic,
    ) -> None:
        given = {name: value for name, value in locals().items() if name in Settings.__dataclass_fields__}
        self._wanted = Settings(**given)
        super().__init__(
            "WSG-50",
            stroke_mm=TYPICAL.stroke_mm,
            min_force_n=on_finger(TYPICAL.min_force_n, finger_share),
            max_force_n=min(max_force_n, on_finger(TYPICAL.max_force_n, finger_share)),
            max_speed_mm_s=max_speed_mm_s,
            clock=clock,
        )
        self._setup = Setup(self.name, self._wanted, self.refused)
        self._link, self._motions = self._setup.link, self._setup.motions

    @property
    def line_counts(self) -> dict[str, int]:
        """What went wrong on the line so far, by kind."""
        return dict(self._link.counts)

    # What the contract asks.

    def _connect(self) -> None:
        self._link.open()
        self._link.sync()
        self._set_up()

    def _close(self) -> None:
        """Announced is only the end of a line to jaws that stand: unannounced it makes the gripper FAST STOP (TCP)."""
        if not (self._link.has_echoed or self._motions.unsettled):  # closed, or nobody there: nothing was begun
            self._link.close()
            return
        try:
            failure = first_failure([self._stand]) or first_failure([self._motions.quiet, self._announce])
        finally:
            self._link.close()
        if failure:
            raise failure

    def _settings(self) -> dict[str, Any]:
        return self._setup.read_back()

    def _recover(self) -> None:
        """Get the line back, then the gripper: reference and settings as on connecting."""
        for number in range(1, self._wanted.reconnect_tries + 1):
            self._setup.reach()
            try:
                self._set_up()
                return
            except (LinkLost, NoReply):
                self._stop_quietly()
                if number == self._wanted.reconnect_tries:
                    raise
            except BaseException:
                self._stop_quietly()
                raise

    def _stop(self) -> None:
        if not self._link.is_open:
            self._setup.open_again()
        for left in reversed(range(self._wanted.reconnect_tries)):
            try:
                self._motions.stop()
                return
            except LinkLost:
                if not left:
                    raise
            _log.warning("%s: the line was lost while it may have moved: opening it again to stop it", self.name)
            self._setup.open_again()

    def _state(self) -> GripperState:
        return self._as_state(read(self._link))

    def _open(self, opening_mm: float) -> GripperState:
        reading = self._ready()
        if reading.grasping in _CLOSED_ON:
            reading = self._release(max(opening_mm, self._further(reading)))
        if abs(reading.opening_mm - opening_mm) > _SAME_MM:
            reading = self._move(opening_mm, closing=opening_mm < reading.opening_mm)
        return self._as_state(reading)

    def _grasp(self, force_n: float, speed_mm_s: float) -> GripperState:
        reading = self._ready()
        if reading.grasping in _CLOSED_ON:
            self._release(self._further(reading))
        self._setup.set_force(force_n)
        width = max(self._wanted.grasp_width_mm, self._setup.openings[0])
        return self._as_state(self._run(commands.grasp(width, speed_mm_s), speed_mm_s, _has_grasped))

    # More than the contract.

    def home(self) -> GripperState:
        """Find the reference. Moves the jaws over their whole stroke. Raises DeviceError."""
        with self._moving("cannot be homed"):
            return self._as_state(self._setup.home())

    def tare(self) -> None:
        """Set the force that the fingers measure to 0. Raises DeviceError without such fingers, and while holding."""
        with self._use("cannot be tared"):
            if read(self._link).grasping is GraspingState.HOLDING:
                raise DeviceError(f"{self.name}: nothing may be held when the fingers are tared; open it first")
            self._link.tell(Packet(Command.TARE))

    def set_acceleration(self, acceleration_mm_s2: float) -> float:
        """Set the acceleration; returns what the gripper has then (mm/s^2). Raises DeviceError."""
        with self._use("cannot set its acceleration"):
            self._setup.check_stands()
            return self._setup.set_acceleration(acceleration_mm_s2)

    def set_soft_limits(self, least_mm: float, greatest_mm: float) -> tuple[float, float] | None:
        """Set the openings that no motion leaves; returns what the gripper has then. Raises DeviceError."""
        with self._use("cannot set its soft limits"):
            self._check("the least opening", least_mm, 0.0, greatest_mm, "mm")
            self._setup.check_stands()
            has = self._setup.set_soft_limits((least_mm, greatest_mm))
            self._take_limits()
            return has

    def clear_soft_limits(self) -> None:
        """Allow the whole stroke. Raises DeviceError."""
        with self._use("cannot clear its soft limits"):
            self._setup.check_stands()
            self._setup.set_soft_limits(())
            self._take_limits()

    def statistics(self) -> Statistics:
        """Grasps, those without a part and those that lost it, as the gripper counts them. Raises DeviceError."""
        with self._use("cannot say its statistics"):
            return self._link.ask(commands.statistics(), commands.statistics_of)

    def info(self) -> Info:
        """What the gripper is. Raises DeviceError."""
        with self._use("cannot say what it is"):
            return self._link.ask(commands.ask(Command.INFO), commands.info)

    def speed(self) -> float:
        """Speed of the jaws (mm/s), below 0 when they close. Raises DeviceError."""
        with self._use("cannot say its speed"):
            return self._link.ask(commands.ask(Command.SPEED), commands.number)

    # How.

    def _set_up(self) -> None:
        self._setup.run(may_home=self.may_move)
        self._take_limits()

    def _take_limits(self) -> None:
        """What the gripper can do, below the ceilings."""
        limits, share = self._setup.limits, self._wanted.finger_share
        self.min_opening_mm, self.stroke_mm = self._setup.openings
        self.min_force_n = on_finger(limits.min_force_n, share)
        self.max_force_n = min(self._wanted.max_force_n, on_finger(limits.max_force_n, share))
        self.min_speed_mm_s = limits.min_speed_mm_s
        self.max_speed_mm_s = min(self._wanted.max_speed_mm_s, limits.max_speed_mm_s)

    def _stand(self) -> None:
        """Stop what moves, also where a motion was begun and the line was lost: a serial one tells the jaws nothing."""
        if self._link.is_open:
            self._setup.stop_if_it_moves(self._stop)
        else:
            self._stop()

    def _announce(self) -> None:
        self._link.tell(commands.disconnect())

    def _stop_quietly(self) -> None:
        try:
            self._stop()
        except DeviceError as error:
            _log.warning("%s: while it was stopped: %s", self.name, error)

    def _ready(self) -> Reading:
        reading = read(self._link)
        check_ready(reading)
        return reading

    def _further(self, reading: Reading) -> float:
        """A little wider than it is, to let go."""
        return min(reading.opening_mm + _REGRIP_MM, self._setup.openings[1])

    def _release(self, width_mm: float) -> Reading:
        speed = self._speed_of_opening()
        return self._run(commands.release(width_mm, speed), speed, _is_at(width_mm))

    def _move(self, width_mm: float, *, closing: bool) -> Reading:
        """Pre-position; when that closes the jaws, with no more than the least force."""
        if closing:
            self._setup.set_force(self.min_force_n)
        speed = self._speed_of_opening()
        return self._run(commands.move(width_mm, speed), speed, _is_at(width_mm))

    def _run(self, packet: Packet, speed_mm_s: float, done: Done) -> Reading:
        seconds = self._setup.limits.stroke_mm / speed_mm_s + _SLACK_S + self._wanted.timeout_s
        return self._motions.run(packet, seconds, done)

    def _speed_of_opening(self) -> float:
        return min(max(self._wanted.opening_speed_mm_s, self._setup.limits.min_speed_mm_s), self.max_speed_mm_s)

    def _as_state(self, reading: Reading) -> GripperState:
        if reading.system & SystemState.FAST_STOP or reading.grasping not in _WORDS:
            raise DeviceError(f"{self.name} is in FAST STOP: {causes(reading.system)}; look why, then call recover()")
        word = _WORDS[reading.grasping]
        if word == "holding" and reading.opening_mm < self._wanted.least_part_mm:
            word = "no_part"
        return GripperState(reading.opening_mm, on_finger(reading.force_n, self._wanted.finger_share), word)


def _has_grasped(reading: Reading, _: Status | None) -> bool:
    return reading.grasping in _CLOSED_ON


def _is_at(width_mm: float) -> Done:
    def done(reading: Reading, _: Status | None) -> bool:
        return reading.grasping is GraspingState.IDLE and abs(reading.opening_mm - width_mm) <= _REACHED_MM

    return done
