"""Supervised motions of a WSG-50: its state tells if a motion has ended; its replies only trigger a read.

A reply can be lost, late or duplicated, and a motion command that is sent twice may be executed twice. Therefore a
motion has ended when the gripper reports that it is still, in a possible end state of the motion. The command is sent
again, once, only if the gripper is still and has not executed it. During a motion the state arrives as automatic
updates every few milliseconds; without them the motion is stopped.
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
"""Size of one update of both states: frames of 8 bytes, and payloads (status and value) of 6 and 3 bytes."""

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
"""Answers after which a command that was not executed may be sent again: perhaps it was not received."""

ACTION = (
    "remove the cause, acknowledge it on the gripper's web page or set acknowledge_faults = true, then start again "
    "or call recover()"
)
"""Action for a person after a fault."""

_POLL_S = 0.01


@dataclass(frozen=True)
class GripperReading:
    """State of the gripper; force_n as the gripper counts it."""

    system: SystemState
    grasping: GraspingState
    opening_mm: float
    force_n: float

    @property
    def is_moving(self) -> bool:
        """Whether the jaws move or will move."""
        return bool(self.system & SystemState.MOVING) or self.grasping in _MOVING


IsDone = Callable[[GripperReading, Status | None], bool]
"""Function from the gripper's state and its last answer (or None) to whether the motion was executed."""


def read(link: Link) -> GripperReading:
    """Read the gripper's state; raise DeviceError if this fails."""
    return GripperReading(
        link.query(commands.query(CommandId.SYSTEM_STATE), commands.system_state),
        link.query(commands.query(CommandId.GRASPING_STATE), commands.grasping_state),
        link.query(commands.query(CommandId.OPENING), commands.number),
        link.query(commands.query(CommandId.FORCE), commands.number),
    )


def fault_names(system: SystemState) -> str:
    """Return the faults in a system state as text."""
    named = [bit.name or "" for bit in SystemState if bit & system & _FAULTS]
    return ", ".join(named).lower().replace("_", " ") or "no fault flag is set: a stop at the gripper, or a lost link"


def check_ready(reading: GripperReading) -> None:
    """Raise DeviceError unless the gripper can execute a motion."""
    if reading.system & SystemState.FAST_STOP or reading.grasping is GraspingState.ERROR:
        raise DeviceError(f"the gripper is in FAST STOP or in an error state ({fault_names(reading.system)}); {ACTION}")
    if not reading.system & SystemState.REFERENCED:
        raise DeviceError("the gripper has lost its reference; call recover(), which homes it")
    if reading.is_moving:
        raise DeviceError("the gripper is still moving; call stop() before the next motion")


class Motions:
    """Runs motions over a link.

    Args:
        link: The link.
        max_age_s: Largest age of the state during a motion.
        period_ms: Period of the updates.

    Attributes:
        may_be_moving: Whether the jaws may move: a motion was started, and they have not been still since.
        common_state: System state bits that all updates of the last motion had in common.
    """

    def __init__(self, link: Link, *, max_age_s: float, period_ms: int) -> None:
        self.link, self.max_age_s, self.period_ms = link, max_age_s, period_ms
        self.may_be_moving = False
        self.common_state = SystemState(0)

    def read(self) -> GripperReading:
        """Read the gripper's state and update `may_be_moving`; raise DeviceError if this fails."""
        reading = read(self.link)
        self.may_be_moving = self.may_be_moving and reading.is_moving
        return reading

    def run(self, packet: Packet, seconds: float, done: IsDone) -> GripperReading:
        """Run a motion and return the gripper's state at its end.

        Args:
            packet: The motion command.
            seconds: Longest duration.
            done: Returns whether the motion was executed.

        Raises:
            DeviceError: The motion failed; the jaws may still move.
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
            f"the gripper answered {answer} to {command_name(packet.id)} and rests at "
            f"{reading.opening_mm:.1f} mm, {reading.grasping.name.lower()}{stop}; check it, then call recover()"
        )

    def stop(self) -> None:
        """Stop the jaws, by FAST STOP if STOP fails, and wait until they are still; raise DeviceError if they move."""
        limit_s = self.max_age_s + self.link.timeout_s
        self._send_until_answered((_STOP, _STOP, _FAST_STOP, _FAST_STOP))
        if self._last_reading(time.monotonic() + limit_s).is_moving:
            self._send_until_answered((_FAST_STOP, _FAST_STOP))
            self._wait_until_still(time.monotonic() + limit_s)
        self.stop_updates()

    def stop_updates(self) -> None:
        """End the automatic updates; raise DeviceError if this fails."""
        for command in _UPDATED:
            self.link.send(commands.query(command))

    def _send_until_answered(self, packets: Sequence[Packet]) -> None:
        """Send packets one after the other until one is answered."""
        for number, packet in enumerate(packets, start=1):
            if packet.id == CommandId.FAST_STOP:
                _log.warning("STOP has failed: sending FAST STOP")
            try:
                self.link.send_urgent(packet)
                return
            except CommandFailed:
                return  # received; the state is read next
            except NoReply:
                if number == len(packets):
                    raise
                self.link.pad()

    def _watch(self, packet: Packet, deadline: float) -> Status | None:
        """Send the motion and return its last answer, or None if the gripper is still and has not answered."""
        link = self.link
        for command in _UPDATED:
            link.send(commands.update(command, self.period_ms))
        self.may_be_moving, self.common_state = True, ~SystemState(0)
        link.begin(packet)
        still_since = time.monotonic()
        while True:
            status = link.poll(packet.id, _POLL_S)
            now = time.monotonic()
            if status not in (None, Status.CMD_PENDING):
                break
            self._check_age(now)
            if self._is_moving() or status is Status.CMD_PENDING:
                still_since = now
            if now - still_since > link.timeout_s:
                break
            if now > deadline:
                raise DeviceError(f"the gripper did not end {command_name(packet.id)} in time and still moves")
        link.require_sync()
        self.stop_updates()
        return status

    def _check_age(self, now: float) -> None:
        """Watchdog: send FAST STOP and raise DeviceError if updates are missing."""
        if now - self.link.updates[CommandId.SYSTEM_STATE][1] <= self.max_age_s:
            return
        self.link.pump(0.0)  # this program may have been suspended: process the updates that have arrived
        age = time.monotonic() - self.link.updates[CommandId.SYSTEM_STATE][1]
        if age <= self.max_age_s:
            return
        error = DeviceError(
            f"the state of the moving gripper must be at most {self.max_age_s:g} s old, got {age:.2g} s: sent FAST "
            "STOP; is the link overloaded?"
        )
        try:
            self.link.send_urgent(_FAST_STOP)
        except DeviceError as second:
            error.add_note(str(second))
        raise error

    def _is_moving(self) -> bool:
        """Return whether the last updates report a motion; keep in `common_state` only bits that they have."""
        try:
            system = commands.system_state(self.link.updates[CommandId.SYSTEM_STATE][0])
            grasping = commands.grasping_state(self.link.updates[CommandId.GRASPING_STATE][0])
        except WireError:
            return True  # unknown: read again
        self.common_state &= system
        return bool(system & SystemState.MOVING) or grasping in _MOVING

    def _wait_until_still(self, deadline: float) -> GripperReading:
        """Return the gripper's state when it is still; raise DeviceError at the deadline."""
        reading = self._last_reading(deadline)
        if reading.is_moving:
            raise DeviceError(
                f"the gripper should be still, but moves at {reading.opening_mm:.1f} mm: switch off its power"
            )
        return reading

    def _last_reading(self, deadline: float) -> GripperReading:
        """Return the gripper's state when it is still, or at the deadline."""
        while (reading := self.read()).is_moving and time.monotonic() < deadline:
            self.link.pump(_POLL_S)
        return reading
