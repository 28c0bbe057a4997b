"""Commands and replies of the WSG-50: builders of commands, parsers of replies. No I/O.

A reply has the id of its command, and its payload begins with a status u16; parameters follow only if the status is
SUCCESS. A motion command gets the reply PENDING first, and a second reply of the same id at its end. An automatic
update is an unsolicited reply.

Sources: as in robot.drivers.wsg50.codec. Commands that the driver does not use are left out. Lengths in mm, speeds in
mm/s, accelerations in mm/s^2, forces in N as the gripper counts them (see WSG50Settings.to_finger_force). Invalid
arguments and replies raise WireError.
"""

import enum
import math
import struct
from dataclasses import dataclass
from typing import Any

from robot.drivers.wsg50.codec import Packet, WireError


class CommandId(enum.IntEnum):
    """Ids of commands."""

    LOOP = 0x06
    DISCONNECT = 0x07
    HOME = 0x20
    MOVE = 0x21
    STOP = 0x22
    FAST_STOP = 0x23
    ACKNOWLEDGE = 0x24
    GRASP = 0x25
    RELEASE = 0x26
    SET_ACCELERATION = 0x30
    GET_ACCELERATION = 0x31
    SET_FORCE_LIMIT = 0x32
    GET_FORCE_LIMIT = 0x33
    SET_SOFT_LIMITS = 0x34
    GET_SOFT_LIMITS = 0x35
    TARE = 0x38
    SYSTEM_STATE = 0x40
    GRASPING_STATE = 0x41
    OPENING = 0x43
    FORCE = 0x45
    INFO = 0x50
    LIMITS = 0x53


UPDATING = frozenset({CommandId.SYSTEM_STATE, CommandId.GRASPING_STATE, CommandId.OPENING, CommandId.FORCE})
"""Commands whose reply the gripper can send periodically."""


class Status(enum.IntEnum):
    """Status of a command in its reply."""

    SUCCESS = 0
    NOT_AVAILABLE = 1
    NO_SENSOR = 2
    NOT_INITIALIZED = 3
    ALREADY_RUNNING = 4
    FEATURE_NOT_SUPPORTED = 5
    INCONSISTENT_DATA = 6
    TIMEOUT = 7
    READ_ERROR = 8
    WRITE_ERROR = 9
    INSUFFICIENT_RESOURCES = 10
    CHECKSUM_ERROR = 11
    NO_PARAM_EXPECTED = 12
    NOT_ENOUGH_PARAMS = 13
    CMD_UNKNOWN = 14
    CMD_FORMAT_ERROR = 15
    ACCESS_DENIED = 16
    ALREADY_OPEN = 17
    CMD_FAILED = 18
    CMD_ABORTED = 19
    INVALID_HANDLE = 20
    NOT_FOUND = 21
    NOT_OPEN = 22
    IO_ERROR = 23
    INVALID_PARAMETER = 24
    INDEX_OUT_OF_BOUNDS = 25
    CMD_PENDING = 26
    OVERRUN = 27
    RANGE_ERROR = 28
    AXIS_BLOCKED = 29
    FILE_EXISTS = 30


class SystemState(enum.IntFlag):
    """Bits of the system state; unknown bits are preserved."""

    REFERENCED = 1 << 0
    MOVING = 1 << 1
    BLOCKED_MINUS = 1 << 2
    BLOCKED_PLUS = 1 << 3
    SOFT_LIMIT_MINUS = 1 << 4
    SOFT_LIMIT_PLUS = 1 << 5
    AXIS_STOPPED = 1 << 6
    TARGET_REACHED = 1 << 7
    OVERDRIVE = 1 << 8
    FORCE_CONTROL = 1 << 9
    FAST_STOP = 1 << 12
    TEMPERATURE_WARNING = 1 << 13
    TEMPERATURE_FAULT = 1 << 14
    POWER_FAULT = 1 << 15
    CURRENT_FAULT = 1 << 16
    FINGER_FAULT = 1 << 17
    COMMAND_FAILURE = 1 << 18
    SCRIPT_RUNNING = 1 << 19
    SCRIPT_FAILURE = 1 << 20


class GraspingState(enum.IntEnum):
    """State of the grasp as the gripper reports it."""

    IDLE = 0
    GRASPING = 1
    NO_PART = 2
    PART_LOST = 3
    HOLDING = 4
    RELEASING = 5
    POSITIONING = 6
    ERROR = 7


@dataclass(frozen=True)
class GripperInfo:
    """Identity of the gripper; kind: the vendor's type number; firmware: one digit for each nibble."""

    kind: int
    hardware: int
    firmware: int
    serial: int


@dataclass(frozen=True)
class GripperLimits:
    """Limits of the gripper."""

    stroke_mm: float
    min_speed_mm_s: float
    max_speed_mm_s: float
    min_acceleration_mm_s2: float
    max_acceleration_mm_s2: float
    min_force_n: float
    max_force_n: float
    overdrive_force_n: float


def packet(command: CommandId, *numbers: float) -> Packet:
    """Build a command with its lengths, speeds, forces or accelerations."""
    try:
        packed = struct.pack(f"<{len(numbers)}f", *numbers)
    except (struct.error, OverflowError) as error:
        raise WireError(f"numbers must fit 32 bits, got {numbers}") from error
    if not all(map(math.isfinite, numbers)):
        raise WireError(f"numbers must be finite, got {numbers}")
    return Packet(command, packed)


def home(direction: int = 0) -> Packet:
    """Build the homing command (reference run); direction: 0 as configured, 1 outward, 2 inward."""
    if direction not in (0, 1, 2):
        raise WireError(f"the direction of homing must be 0, 1 or 2, got {direction}")
    return Packet(CommandId.HOME, bytes([direction]))


def move(width_mm: float, speed_mm_s: float) -> Packet:
    """Build the command to pre-position the fingers, which stop (and do not clamp) when blocked."""
    return Packet(CommandId.MOVE, b"\x02" + packet(CommandId.MOVE, width_mm, speed_mm_s).payload)


def acknowledge() -> Packet:
    """Build the command that ends a FAST STOP."""
    return Packet(CommandId.ACKNOWLEDGE, b"ack")


def query(command: CommandId) -> Packet:
    """Build the query of a value; for an UPDATING command it also ends the automatic updates."""
    return Packet(command, bytes(3) if command in UPDATING else b"")


def update(command: CommandId, period_ms: int) -> Packet:
    """Build the command for automatic updates of a value every `period_ms` (1 to 65535)."""
    if command not in UPDATING:
        raise WireError(f"only {', '.join(sorted(each.name for each in UPDATING))} have updates, got {command!r}")
    if not 1 <= period_ms <= 0xFFFF:
        raise WireError(f"a period must be from 1 to 65535 ms, got {period_ms}")
    return Packet(command, struct.pack("<BH", 1, period_ms))


def reply(packet: Packet) -> tuple[Status, bytes]:
    """Return the status and parameters of a reply; raise WireError if the status is missing or unknown."""
    if len(packet.payload) < 2:
        raise WireError(f"the reply {command_name(packet.id)} must have a status of 2 bytes, got {len(packet.payload)}")
    number = int.from_bytes(packet.payload[:2], "little")
    try:
        return Status(number), packet.payload[2:]
    except ValueError as error:
        raise WireError(f"the reply {command_name(packet.id)} has the unknown status {number}") from error


def number(parameters: bytes) -> float:
    """Parse a length, speed, force or acceleration; raise WireError if it is not a finite number."""
    return _numbers("<f", parameters)[0]


def soft_limits(parameters: bytes) -> tuple[float, float]:
    """Parse the lower and upper opening (mm)."""
    minus, plus = _numbers("<2f", parameters)
    return minus, plus


def limits(parameters: bytes) -> GripperLimits:
    """Parse the limits of the gripper."""
    return GripperLimits(*_numbers("<8f", parameters))


def info(parameters: bytes) -> GripperInfo:
    """Parse the identity of the gripper."""
    return GripperInfo(*_unpack("<BBHI", parameters))


def system_state(parameters: bytes) -> SystemState:
    """Parse the system state."""
    return SystemState(_unpack("<I", parameters)[0])


def grasping_state(parameters: bytes) -> GraspingState:
    """Parse the state of the grasp."""
    number = _unpack("<B", parameters)[0]
    try:
        return GraspingState(number)
    except ValueError as error:
        raise WireError(f"a state of the grasp must be from 0 to {max(GraspingState)}, got {number}") from error


def command_name(command_id: int) -> str:
    """Return the name of a command for messages, such as "GRASP (25h)"."""
    name = CommandId(command_id).name if command_id in list(CommandId) else "to an unknown command"
    return f"{name} ({command_id:02X}h)"


def _unpack(form: str, parameters: bytes) -> tuple[Any, ...]:
    if len(parameters) != struct.calcsize(form):
        raise WireError(f"parameters must be {struct.calcsize(form)} bytes, got {len(parameters)}")
    return struct.unpack(form, parameters)


def _numbers(form: str, parameters: bytes) -> tuple[float, ...]:
    values = _unpack(form, parameters)
    if not all(map(math.isfinite, values)):
        raise WireError(f"numbers must be finite, got {values}")
    return values
