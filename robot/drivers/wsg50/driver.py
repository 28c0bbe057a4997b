"""Driver of the WSG-50 parallel gripper (Weiss Robotics, SCHUNK) over TCP. Tested with an emulator, not with a gripper.

Before use, set on the gripper's web page:

* The binary command interface over TCP: on.
* "Part width tolerance" and "clamping travel": their maximum. The width of the object is unknown, so GRASP is sent with
  `grasp_width_mm`, by default 0. (The driver of the Robotics Library gives the same advice.)
* "Error state on TCP disconnect": on. Then the jaws stop if this program is killed, or if the connection is lost.

Replies, results of motions and automatic updates arrive interleaved and are distinguished only by their ids. The
gripper answers in the order of its commands. Before each motion it must echo a fresh token: all packets before the
echo, such as the result of a motion that was stopped, are old and are dropped. A command without an answer closes the
connection. A motion has ended when its result has arrived and the gripper reports that it is still, in a possible end
state of the motion. A motion command is never sent twice. During a motion the state arrives as automatic updates every
few milliseconds; without them the motion is stopped.

There is no reader thread: the waiting caller reads, because updates matter only during a wait.
"""

import contextlib
import itertools
import logging
import math
import select
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Annotated, Any, TypeVar

from msgspec import Meta

from robot.devices import Clock, Gripper
from robot.drivers.wsg50 import codec
from robot.drivers.wsg50.codec import (
    CommandId,
    GraspingState,
    GripperLimits,
    Packet,
    Status,
    SystemState,
    command_name,
    decode,
    encode,
)
from robot.errors import DeviceError, RobotConfigError
from robot.readings import GripperState, GripperStatus
from robot.settings import TypedSettings

_T = TypeVar("_T")
_log = logging.getLogger(__name__)

# The link -----------------------------------------------------------------------------------------------------

_CHUNK = 1 << 16
"""Bytes of a read, more than ten seconds of updates, in case this program was suspended."""


class LinkLost(DeviceError):
    """The gripper cannot be reached, does not answer, or closed the connection."""


class StillMoving(DeviceError):
    """The jaws move although they should be still."""


class CommandFailed(DeviceError):
    """The gripper answered with a status other than SUCCESS."""

    def __init__(self, command_id: int, status: Status) -> None:
        super().__init__(f"the gripper answered {command_name(command_id)} with {status.name} (status {int(status)})")


class Link:
    """The TCP connection to one gripper. Its methods raise LinkLost, CommandFailed or WireError, all DeviceErrors.

    Attributes:
        updates: For each updating command, its last parameters and their time of arrival (s, time.monotonic).
    """

    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        self.address, self.timeout_s = (host, port), timeout_s
        self.updates: dict[int, tuple[bytes, float]] = {}
        self._socket: socket.socket | None = None
        self._buffer = bytearray()
        self._tokens = itertools.count()

    @property
    def is_open(self) -> bool:
        """Whether it is connected."""
        return self._socket is not None

    def open(self) -> None:
        """Connect unless it is connected; send nothing."""
        if self._socket is not None:
            return
        try:
            self._socket = socket.create_connection(self.address, self.timeout_s)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            raise LinkLost(f"{self._name} cannot be reached: {error}; is it on and connected?") from error
        self.updates.clear()
        self._buffer.clear()

    def close(self) -> None:
        """Close the connection if it is open."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def query(self, packet: Packet, parse: Callable[[bytes], _T]) -> _T:
        """Send a command and return its parsed reply."""
        self._write(packet)
        for status, parameters in self._replies(packet.id, self.timeout_s):
            if status is Status.CMD_PENDING:
                continue
            if status is not Status.SUCCESS:
                raise CommandFailed(packet.id, status)
            return parse(parameters)
        raise self._silence(command_name(packet.id))

    def send(self, packet: Packet) -> None:
        """Send a command and wait for its reply."""
        self.query(packet, bytes)

    def sync(self) -> None:
        """Have the gripper echo a fresh token, and drop all packets before it."""
        token = next(self._tokens).to_bytes(8, "little")
        self._write(Packet(CommandId.LOOP, token))
        echo = Packet(CommandId.LOOP, bytes(2) + token)
        if not any(packet == echo for packet in self._packets(self.timeout_s)):
            raise self._silence(command_name(CommandId.LOOP))

    def begin(self, packet: Packet) -> None:
        """Send a command whose replies `poll` returns, after synchronising."""
        self.sync()
        self._write(packet)

    def poll(self, command_id: int, timeout_s: float) -> Status | None:
        """Return the status of the next reply to a command, PENDING too, or None after `timeout_s`."""
        return next((status for status, _ in self._replies(command_id, timeout_s)), None)

    @property
    def _name(self) -> str:
        return f"the gripper at {self.address[0]}:{self.address[1]}"

    def _silence(self, command: str) -> LinkLost:
        """Close the connection and return the error."""
        self.close()
        return LinkLost(f"{self._name} did not answer {command} within {self.timeout_s:g} s; is it on and connected?")

    def _replies(self, command_id: int, seconds: float) -> Iterator[tuple[Status, bytes]]:
        """Yield status and parameters of the replies to a command that arrive within `seconds`."""
        return (codec.reply(packet) for packet in self._packets(seconds) if packet.id == command_id)

    def _packets(self, seconds: float) -> Iterator[Packet]:
        """Yield the packets that arrive within `seconds`, and store updates."""
        deadline = time.monotonic() + seconds
        while True:
            used, packet = decode(self._buffer)
            del self._buffer[:used]
            if packet is not None:
                if packet.id in codec.UPDATING and packet.payload[:2] == bytes(2):
                    self.updates[packet.id] = (packet.payload[2:], time.monotonic())
                yield packet
                continue
            with self._connected() as connection:
                if not select.select([connection], [], [], max(0.0, deadline - time.monotonic()))[0]:
                    return
                data = connection.recv(_CHUNK)
                if not data:
                    raise OSError("the gripper closed it")
            self._buffer += data

    def _write(self, packet: Packet) -> None:
        with self._connected() as connection:
            connection.sendall(encode(packet))

    @contextlib.contextmanager
    def _connected(self) -> Iterator[socket.socket]:
        """Give the connection; if it was lost, close it and raise LinkLost."""
        try:
            if self._socket is None:
                raise OSError("it is closed")
            yield self._socket
        except OSError as error:
            self.close()
            raise LinkLost(
                f"the connection to {self._name} was lost: {error}; check its cable and power, recover() opens it again"
            ) from error


# The gripper --------------------------------------------------------------------------------------------------

TYPICAL_LIMITS = GripperLimits(110.0, 5.0, 420.0, 100.0, 5000.0, 5.0, 80.0, 120.0)
"""Limits of a WSG-50-110, used until the gripper has reported its own."""

_STATUS_OF: dict[GraspingState, GripperStatus] = {
    GraspingState.IDLE: "idle",
    GraspingState.GRASPING: "moving",
    GraspingState.NO_PART: "no_part",
    GraspingState.PART_LOST: "part_lost",
    GraspingState.HOLDING: "holding",
    GraspingState.RELEASING: "moving",
    GraspingState.POSITIONING: "moving",
}
_CLOSED_STATES = {GraspingState.HOLDING, GraspingState.NO_PART, GraspingState.PART_LOST}
"""States that end only by RELEASE; in them, the gripper refuses GRASP."""

_UPDATED = (CommandId.SYSTEM_STATE, CommandId.GRASPING_STATE)
_UPDATE_MS = 20
"""Period of the state updates during a motion."""

_REACHED_MM, _SAME_MM = 1.0, 0.1
"""Tolerance of a reached target, and distance below which no motion is needed."""
_MIN_PART_MM = 1.0
"""With a smaller opening the fingers touch each other and hold no part."""
_REGRIP_MM = 5.0
"""Opening motion that releases a held object before another grasp."""
_HOMING_S = 30.0
"""Longest duration of homing."""
_SLACK_S = 2.0
"""Extra time of a motion, for acceleration and the link."""
_POLL_S = 0.01
_RECONNECT_S = (0.0, 0.2, 1.0, 5.0)
"""Waits before the tries to open a lost connection."""
_ROUNDING = 1e-6
"""Accepted relative excess of the force limit, a rounding error of 32-bit numbers."""
_ACTION = (
    "remove the cause, acknowledge it on the gripper's web page or set acknowledge_faults = true, then start again "
    "or call recover()"
)


@dataclass(frozen=True, kw_only=True)
class WSG50Settings(TypedSettings):
    """Settings of a WSG-50. Forces are those on each finger.

    Attributes:
        host: Address of the gripper.
        timeout_s: Longest wait for an answer.
        acknowledge_faults: Whether to log and acknowledge a FAST STOP; if false, a person must acknowledge it.
        grasp_width_mm: Nominal width of the object, sent with each GRASP; 0 if unknown.
        finger_share: Fraction of the gripper's force on each finger; see `to_finger_force`.
        max_force_n: Upper limit of forces.
        max_speed_mm_s: Upper limit of speeds, and the speed of opening.
        max_state_age_s: The jaws are stopped if no state arrives for this long during a motion.
    """

    host: str
    port: Annotated[int, Meta(ge=1, le=65535)] = 1000
    timeout_s: Annotated[float, Meta(ge=1e-3, le=600)] = 1.0
    acknowledge_faults: bool = False
    grasp_width_mm: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    finger_share: Annotated[float, Meta(ge=0.1, le=1.0)] = 0.5
    max_force_n: Annotated[float, Meta(ge=1e-3, le=1e4)] = 40.0
    max_speed_mm_s: Annotated[float, Meta(ge=1e-3, le=1e4)] = 420.0
    max_state_age_s: Annotated[float, Meta(ge=0.04, le=60)] = 0.5

    def to_finger_force(self, gripper_n: float) -> float:
        """Convert the gripper's force (N) to the force on each finger (N).

        The gripper's force limit is the sum over both fingers: SCHUNK's manual of its fieldbus interface defines the
        register FORCELIMIT as "twice the nominal force that is applied to the part to be grasped". So the fraction is
        0.5. We assume that the reported force (45h) is defined like the limit. Without force-measuring fingers, the
        gripper derives the force from its motor current. With a force gauge, set `finger_share` to the measured force
        on one finger divided by the limit.
        """
        return gripper_n * self.finger_share


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
        return bool(self.system & SystemState.MOVING) or _STATUS_OF.get(self.grasping) == "moving"


IsDone = Callable[[GripperReading], bool]
"""Function from the gripper's state to whether a motion was executed."""


class WSG50(Gripper):
    """A WSG-50; the fields of WSG50Settings are keyword arguments of the constructor.

    `stop` releases a held object, because STOP ends the gripper's force control. Use the driver from one thread only;
    to stop the gripper from another thread, interrupt the driver's thread (Ctrl-C).
    """

    Settings = WSG50Settings

    def __init__(self, *, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Check the settings; raise RobotConfigError for one out of range."""
        options = self._options = WSG50Settings(**settings)
        super().__init__(
            "WSG-50",
            stroke_mm=TYPICAL_LIMITS.stroke_mm,
            min_force_n=options.to_finger_force(TYPICAL_LIMITS.min_force_n),
            max_force_n=min(options.max_force_n, options.to_finger_force(TYPICAL_LIMITS.max_force_n)),
            max_speed_mm_s=options.max_speed_mm_s,
            clock=clock,
        )
        self._link = Link(options.host, options.port, options.timeout_s)
        self._limits = TYPICAL_LIMITS
        self._may_be_moving = False
        """Whether a motion was started and the jaws have not been still since."""

    # Methods of the contract.

    def _connect(self) -> None:
        self._link.open()
        self._link.sync()
        self._set_up()

    def _close(self) -> None:
        """If the jaws move, stop them. Then send DISCONNECT, without which the gripper enters FAST STOP."""
        try:
            if self._link.is_open or self._may_be_moving:
                self._stop_if_moving()
                self._stop_updates()
                self._link.send(Packet(CommandId.DISCONNECT))
        finally:
            self._link.close()

    def _settings(self) -> dict[str, Any]:
        force = self._query(CommandId.GET_FORCE_LIMIT, codec.number)
        return {
            "info": self._query(CommandId.INFO, codec.info),
            "limits": asdict(self._query(CommandId.LIMITS, codec.limits)),
            "force_limit_n": self._options.to_finger_force(force),
            "finger_share": self._options.finger_share,
        }

    def _recover(self) -> None:
        """Open a lost connection again, then restore reference and settings as on connecting."""
        with self._moving("cannot recover"):
            for tries_left, wait_s in zip(reversed(range(len(_RECONNECT_S))), _RECONNECT_S, strict=True):
                time.sleep(wait_s)
                try:
                    self._link.open()
                    self._link.sync()
                    break
                except LinkLost as error:
                    if not tries_left:
                        raise
                    _log.warning("%s: %s; connecting again", self.name, error)
            self._set_up()

    def _stop(self) -> None:
        """Stop the jaws; if the connection is lost during a possible motion, open it again to do so."""
        try:
            self._stop_over_link()
        except LinkLost:
            if not self._may_be_moving:
                raise
            _log.warning("%s: lost the connection during a possible motion: opening it again to stop", self.name)
            self._stop_over_link()

    def _state(self) -> GripperState:
        return self._as_state(self._read())

    def _open(self, opening_mm: float) -> GripperState:
        reading = self._read_ready()
        if reading.grasping in _CLOSED_STATES:
            reading = self._release(max(opening_mm, self._wider_opening(reading)))
        if abs(reading.opening_mm - opening_mm) > _SAME_MM:
            if opening_mm < reading.opening_mm:  # it may close on something
                self._set_force(self.min_force_n)
            packet = codec.move(opening_mm, self.max_speed_mm_s)
            reading = self._run_at(self.max_speed_mm_s, packet, _is_at(opening_mm))
        return self._as_state(reading)

    def _grasp(self, force_n: float, speed_mm_s: float) -> GripperState:
        reading = self._read_ready()
        if reading.grasping in _CLOSED_STATES:
            self._release(self._wider_opening(reading))
        self._set_force(force_n)
        packet = codec.command(CommandId.GRASP, self._options.grasp_width_mm, speed_mm_s)
        return self._as_state(self._run_at(speed_mm_s, packet, lambda reading: reading.grasping in _CLOSED_STATES))

    # Reading.

    def _query(self, command: CommandId, parse: Callable[[bytes], Any]) -> Any:
        return self._link.query(codec.query(command), parse)

    def _read(self) -> GripperReading:
        """Read the gripper's state and update `_may_be_moving`."""
        reading = GripperReading(
            self._query(CommandId.SYSTEM_STATE, codec.system_state),
            self._query(CommandId.GRASPING_STATE, codec.grasping_state),
            self._query(CommandId.OPENING, codec.number),
            self._query(CommandId.FORCE, codec.number),
        )
        self._may_be_moving = self._may_be_moving and reading.is_moving
        return reading

    def _read_ready(self) -> GripperReading:
        """Read the state; raise DeviceError unless the gripper can execute a motion."""
        reading = self._read()
        self._check_fault(reading)
        if not reading.system & SystemState.REFERENCED:
            raise DeviceError(f"{self.name} has lost its reference; call recover(), which homes it")
        if reading.is_moving:
            raise DeviceError(f"{self.name} is still moving; call stop() before the next motion")
        return reading

    def _check_fault(self, reading: GripperReading) -> None:
        if reading.system & SystemState.FAST_STOP or reading.grasping is GraspingState.ERROR:
            raise DeviceError(f"{self.name} is in FAST STOP or in an error state: {reading.system.faults}; {_ACTION}")

    def _as_state(self, reading: GripperReading) -> GripperState:
        self._check_fault(reading)
        status = _STATUS_OF[reading.grasping]
        if status == "holding" and reading.opening_mm < _MIN_PART_MM:
            status = "no_part"
        return GripperState(reading.opening_mm, self._options.to_finger_force(reading.force_n), status)

    # Motions.

    def _release(self, width_mm: float) -> GripperReading:
        packet = codec.command(CommandId.RELEASE, width_mm, self.max_speed_mm_s)
        return self._run_at(self.max_speed_mm_s, packet, _is_at(width_mm))

    def _wider_opening(self, reading: GripperReading) -> float:
        """Return an opening slightly wider than the current one, to release the object."""
        return min(reading.opening_mm + _REGRIP_MM, self.stroke_mm)

    def _run_at(self, speed_mm_s: float, packet: Packet, done: IsDone) -> GripperReading:
        seconds = self._limits.stroke_mm / speed_mm_s + _SLACK_S + self._options.timeout_s
        return self._run(packet, seconds, done)

    def _run(self, packet: Packet, seconds: float, done: IsDone) -> GripperReading:
        """Run a motion for at most `seconds` and return the state at its end; raise DeviceError unless it is `done`."""
        deadline = time.monotonic() + seconds
        status = self._watch(packet, deadline)
        reading = self._read_until_still(deadline)
        if done(reading):
            return reading
        stop = f", FAST STOP: {reading.system.faults}" if reading.system & SystemState.FAST_STOP else ""
        raise DeviceError(
            f"the gripper answered {status.name} to {command_name(packet.id)} and rests at "
            f"{reading.opening_mm:.1f} mm, {reading.grasping.name.lower()}{stop}; check it, then call recover()"
        )

    def _watch(self, packet: Packet, deadline: float) -> Status:
        """Send the motion and return its result."""
        link = self._link
        for command in _UPDATED:
            link.send(codec.update(command, _UPDATE_MS))
        self._may_be_moving = True
        link.begin(packet)
        while (status := link.poll(packet.id, _POLL_S)) in (None, Status.CMD_PENDING):
            now, limit_s = time.monotonic(), self._options.max_state_age_s
            if (age_s := now - link.updates[CommandId.SYSTEM_STATE][1]) > limit_s:
                raise DeviceError(
                    f"the state of the moving gripper must be at most {limit_s:g} s old, got {age_s:.2g} s; is the "
                    "link overloaded?"
                )
            if now > deadline:
                raise DeviceError(f"the gripper did not end {command_name(packet.id)} in time and still moves")
        self._stop_updates()
        assert status is not None, "the loop ends with a status"
        return status

    def _read_until_still(self, deadline: float) -> GripperReading:
        """Return the gripper's state when it is still; raise DeviceError at the deadline."""
        while (reading := self._read()).is_moving:
            if time.monotonic() > deadline:
                raise StillMoving(
                    f"the gripper should be still, but moves at {reading.opening_mm:.1f} mm: switch off its power"
                )
            time.sleep(_POLL_S)
        return reading

    # Stopping.

    def _stop_over_link(self) -> None:
        """Stop the jaws, by FAST STOP if STOP fails, and wait until they are still; raise DeviceError if they move."""
        self._link.open()
        for command in (CommandId.STOP, CommandId.FAST_STOP):
            with contextlib.suppress(CommandFailed):  # received; the state tells whether it was executed
                self._link.send(Packet(command))
            try:
                self._read_until_still(time.monotonic() + self._options.max_state_age_s + self._link.timeout_s)
                break
            except StillMoving:
                if command is CommandId.FAST_STOP:
                    raise
                _log.warning("%s: STOP has failed: sending FAST STOP", self.name)
        self._stop_updates()

    def _stop_updates(self) -> None:
        for command in _UPDATED:
            self._link.send(codec.query(command))

    def _stop_if_moving(self) -> None:
        """Stop the jaws if they move or may move; else STOP would drop a held object."""
        try:
            is_moving = self._read().is_moving
        except DeviceError as error:
            if isinstance(error, LinkLost) and not self._may_be_moving:
                raise
            is_moving = True  # unknown
        if is_moving:
            self._stop()

    # Connecting.

    def _set_up(self) -> None:
        """Read the limits, end a FAST STOP if allowed, and home if the reference is lost."""
        options = self._options
        limits = self._limits = self._query(CommandId.LIMITS, codec.limits)
        self.min_force_n = options.to_finger_force(limits.min_force_n)
        if options.max_force_n < self.min_force_n or options.max_speed_mm_s < limits.min_speed_mm_s:
            raise RobotConfigError(
                f"{self.name}: the limits must allow at least {self.min_force_n:g} N on each finger and "
                f"{limits.min_speed_mm_s:g} mm/s, the smallest values of the gripper; got {options.max_force_n:g} N "
                f"and {options.max_speed_mm_s:g} mm/s"
            )
        self.max_force_n = min(options.max_force_n, options.to_finger_force(limits.max_force_n))
        self.min_speed_mm_s = limits.min_speed_mm_s
        self.max_speed_mm_s = min(options.max_speed_mm_s, limits.max_speed_mm_s)
        self._stop_if_moving()
        self._end_fast_stop()
        if not self._query(CommandId.SYSTEM_STATE, codec.system_state) & SystemState.REFERENCED:
            if not self.may_move:
                raise DeviceError(f"{self.name} has lost its reference and must be homed, but motion is not allowed")
            _log.warning("%s has lost its reference: homing, the jaws move", self.name)
            self._run(codec.HOME, _HOMING_S, lambda reading: bool(reading.system & SystemState.REFERENCED))
        if self._read().grasping is not GraspingState.HOLDING:  # with a smaller force, the held object would fall
            self._set_force(self.min_force_n)
        self.stroke_mm = limits.stroke_mm
        self._check("grasp_width_mm", options.grasp_width_mm, 0.0, self.stroke_mm, "mm")

    def _end_fast_stop(self) -> None:
        """Acknowledge a FAST STOP and log it, or raise DeviceError if this is not allowed."""
        system = self._query(CommandId.SYSTEM_STATE, codec.system_state)
        if not system & SystemState.FAST_STOP:
            return
        if not self._options.acknowledge_faults:
            raise DeviceError(f"{self.name} is in FAST STOP: {system.faults}; {_ACTION}")
        _log.warning("%s is in FAST STOP (%s): acknowledging it", self.name, system.faults)
        self._link.send(codec.ACKNOWLEDGE)
        if self._query(CommandId.SYSTEM_STATE, codec.system_state) & SystemState.FAST_STOP:
            raise DeviceError(f"{self.name} is still in FAST STOP after acknowledgement: {system.faults}")

    # Settings.

    def _set_force(self, force_n: float) -> None:
        """Set the force limit and read it back; raise DeviceError if the gripper would clamp harder."""
        limit_n = max(force_n / self._options.finger_share, self._limits.min_force_n)
        self._link.send(codec.command(CommandId.SET_FORCE_LIMIT, limit_n))
        has = self._query(CommandId.GET_FORCE_LIMIT, codec.number)
        self.refused.pop("force_n", None)
        if not math.isclose(has, limit_n, rel_tol=0.01):
            self.refused["force_n"] = f"requested {force_n:g}, has {self._options.to_finger_force(has):g}"
        if has > limit_n * (1 + _ROUNDING):
            raise DeviceError(
                f"{self.name}: the force limit (both fingers) must be {limit_n:g} N, but the gripper has "
                f"{has:g} N; the jaws do not close"
            )


def _is_at(width_mm: float) -> IsDone:
    return lambda reading: reading.grasping is GraspingState.IDLE and abs(reading.opening_mm - width_mm) <= _REACHED_MM
