"""Motions of a WSG-50, watched: what it says of itself decides, its replies only tell when to look.

A reply can be lost, late or doubled, and a motion that is sent twice may be done twice. So a motion has ended when the
gripper says that it stands and is in a state that the motion can end in; it is sent again, once, only after the gripper
has said that it stands and has not done it. While it moves, its state comes by itself every few milliseconds; where it
does not, the motion is stopped.
"""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from robot.drivers.wsg50 import commands
from robot.drivers.wsg50.codec import Packet, WireError
from robot.drivers.wsg50.commands import CommandId, GraspingState, Status, SystemState, command_name
from robot.drivers.wsg50.link import CommandFailed, Link, NoReply
from robot.errors import DeviceError

_log = logging.getLogger(__name__)
_STOP, _FAST_STOP = Packet(CommandId.STOP), Packet(CommandId.FAST_STOP)
_UPDATED = (CommandId.SYSTEM_STATE, CommandId.GRASPING_STATE)
UPDATE_BYTES = 25
"""Of an update of each: 10 around a payload, and status and value, 6 and 3."""

_MOVING = {GraspingState.GRASPING, GraspingState.RELEASING, GraspingState.POSITIONING}
_FAULTS = (
    SystemState.TEMPERATURE_WARNING
    | SystemState.TEMPERATURE_FAULT
    | SystemState.POWER_FAULT
    | SystemState.CURRENT_FAULT
    | SystemState.FINGER_FAULT
    | SystemState.COMMAND_FAILURE
    | SystemState.SCRIPT_FAILURE
)
_RESENDABLE = (None, Status.SUCCESS, Status.CHECKSUM_ERROR)
"""Answers to a motion that the gripper, standing, has not done: it was not heard."""

_POLL_S = 0.01


@dataclass(frozen=True)
class GripperReading:
    """What the gripper says of itself; force_n as the gripper counts it."""

    system: SystemState
    grasping: GraspingState
    opening_mm: float
    force_n: float

    @property
    def is_moving(self) -> bool:
        """Whether the jaws move, or are about to."""
        return bool(self.system & SystemState.MOVING) or self.grasping in _MOVING


IsDone = Callable[[GripperReading, Status | None], bool]
"""Told what the gripper says, and its last answer or None: whether the motion has been done."""


def read(link: Link) -> GripperReading:
    """Ask for all of a Reading. Raises DeviceError."""
    return GripperReading(
        link.query(commands.query(CommandId.SYSTEM_STATE), commands.system_state),
        link.query(commands.query(CommandId.GRASPING_STATE), commands.grasping_state),
        link.query(commands.query(CommandId.OPENING), commands.number),
        link.query(commands.query(CommandId.FORCE), commands.number),
    )


def fault_names(system: SystemState) -> str:
    """Words for the faults in a system state."""
    named = [bit.name or "" for bit in SystemState if bit & system & _FAULTS]
    return ", ".join(named).lower().replace("_", " ") or "no fault flag is set: a stop on the gripper, or a lost line"


def check_ready(reading: GripperReading) -> None:
    """Raise DeviceError unless the gripper can be told to move."""
    if reading.system & SystemState.FAST_STOP or reading.grasping is GraspingState.ERROR:
        raise DeviceError(f"the gripper is in FAST STOP ({fault_names(reading.system)}); look why, then call recover()")
    if not reading.system & SystemState.REFERENCED:
        raise DeviceError("the gripper must know its reference, and has lost it; call recover(), which homes it")
    if reading.is_moving:
        raise DeviceError("the gripper must stand before it is told to move, and is moving; call stop()")


class Motions:
    """Runs motions over a link. max_age_s: how old its state may grow while it moves. period_ms: of the updates."""

    def __init__(self, link: Link, *, max_age_s: float, period_ms: int) -> None:
        self.link, self.max_age_s, self.period_ms = link, max_age_s, period_ms
        self.may_be_moving = False
        """Whether a motion was begun after which the jaws were not yet seen to stand."""
        self.common_state = SystemState(0)
        """What all updates of the last motion had in common."""

    def read(self) -> GripperReading:
        """Ask for all of a Reading, and note whether the jaws stand. Raises DeviceError."""
        reading = read(self.link)
        self.may_be_moving = self.may_be_moving and reading.is_moving
        return reading

    def run(self, packet: Packet, seconds: float, done: IsDone) -> GripperReading:
        """Send a motion, wait until it has ended, for `seconds` at most, and return what the gripper says then.

        Raises DeviceError, and then it may still be moving.
        """
        deadline = time.monotonic() + seconds
        for last_try in (False, True):
            status = self._watch(packet, deadline)
            reading = self._wait_until_still(deadline)
            if done(reading, status):
                return reading
            if reading.system & SystemState.FAST_STOP or status not in _RESENDABLE or last_try:
                break
            self.link.counts["resent"] += 1
        answer = "nothing" if status is None else status.name
        stop = f", FAST STOP: {fault_names(reading.system)}" if reading.system & SystemState.FAST_STOP else ""
        raise DeviceError(
            f"the gripper answered {answer} to {command_name(packet.id)} and stands at {reading.opening_mm:.1f} mm, "
            f"{reading.grasping.name.lower()}{stop}; look at it, then call recover()"
        )

    def stop(self) -> None:
        """Stop the jaws, by FAST STOP if nothing else helps, and see that they stand. Raises DeviceError."""
        patience_s = self.max_age_s + self.link.timeout_s
        self._send_until_answered((_STOP, _STOP, _FAST_STOP, _FAST_STOP))
        if self._last_reading(time.monotonic() + patience_s).is_moving:
            self._send_until_answered((_FAST_STOP, _FAST_STOP))
            self._wait_until_still(time.monotonic() + patience_s)
        self.stop_updates()

    def stop_updates(self) -> None:
        """End the updates. Raises DeviceError."""
        for command in _UPDATED:
            self.link.send(commands.query(command))

    def _send_until_answered(self, packets: Sequence[Packet]) -> None:
        """One after the other, until one is answered."""
        for number, packet in enumerate(packets, start=1):
            if packet.id == CommandId.FAST_STOP:
                _log.warning("the gripper does not stop when told to: telling it to FAST STOP")
            try:
                self.link.send_urgent(packet)
                return
            except CommandFailed:
                return  # heard, and of no use: where it stands is read next
            except NoReply:
                if number == len(packets):
                    raise
                self.link.pad()

    def _watch(self, packet: Packet, deadline: float) -> Status | None:
        """Send the motion and return its last answer, or None where the gripper stands and has not answered."""
        link = self.link
        for command in _UPDATED:
            link.send(commands.update(command, self.period_ms))
        self.may_be_moving, self.common_state = True, ~SystemState(0)
        link.begin(packet)
        stands_since = time.monotonic()
        while True:
            status = link.poll(packet.id, _POLL_S)
            now = time.monotonic()
            if status not in (None, Status.CMD_PENDING):
                break
            self._check_age(now)
            if self._is_moving() or status is Status.CMD_PENDING:
                stands_since = now
            if now - stands_since > link.timeout_s:
                break
            if now > deadline:
                raise DeviceError(f"the gripper must end {command_name(packet.id)} in time, and still moves")
        link.require_sync()
        self.stop_updates()
        return status

    def _check_age(self, now: float) -> None:
        """The watchdog: FAST STOP and DeviceError where the gripper has gone silent."""
        if now - self.link.updates[CommandId.SYSTEM_STATE][1] <= self.max_age_s:
            return
        self.link.pump(0.0)  # it may be this program that was held up: what has come meanwhile counts
        age = time.monotonic() - self.link.updates[CommandId.SYSTEM_STATE][1]
        if age <= self.max_age_s:
            return
        error = DeviceError(
            f"the state of the moving gripper must be at most {self.max_age_s:g} s old, it is {age:.2g} s: told it to "
            "FAST STOP; is the line overloaded?"
        )
        try:
            self.link.send_urgent(_FAST_STOP)
        except DeviceError as second:
            error.add_note(str(second))
        raise error

    def _is_moving(self) -> bool:
        """Whether the last updates say that it moves. Notes them in `common_state`."""
        try:
            system = commands.system_state(self.link.updates[CommandId.SYSTEM_STATE][0])
            grasping = commands.grasping_state(self.link.updates[CommandId.GRASPING_STATE][0])
        except WireError:
            return True  # not known: look again
        self.common_state &= system
        return bool(system & SystemState.MOVING) or grasping in _MOVING

    def _wait_until_still(self, deadline: float) -> GripperReading:
        """What the gripper says when it stands."""
        reading = self._last_reading(deadline)
        if reading.is_moving:
            raise DeviceError(f"the gripper must stand, and still moves at {reading.opening_mm:.1f} mm: stop its power")
        return reading

    def _last_reading(self, deadline: float) -> GripperReading:
        """What the gripper says when it stands, or at the deadline."""
        while (reading := self.read()).is_moving and time.monotonic() < deadline:
            self.link.pump(_POLL_S)
        return reading
