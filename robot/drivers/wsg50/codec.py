"""Bytes of the WSG-50's command interface: packets, commands and replies. No I/O.

A packet is AA AA AA | id u8 | length u16 | payload | checksum u16, all little-endian. A reply has the id of its
command, and its payload begins with a status u16; parameters follow only if the status is SUCCESS. A motion command
gets the reply PENDING first, and a second reply of the same id at its end. An automatic update is an unsolicited reply.

Sources: the gripper's command set reference (firmware 4.0) and public drivers for it. Commands that the driver does not
use are left out. Lengths in mm, speeds in mm/s, accelerations in mm/s^2, forces in N as the gripper counts them (see
WSG50Settings.to_finger_force). Invalid replies raise WireError.
"""

import binascii
import enum
import math
import struct
from dataclasses import dataclass
from typing import Any

from robot.errors import DeviceError

PREAMBLE = b"\xaa\xaa\xaa"
MAX_PAYLOAD = 256
"""Longest accepted payload, above that of any command; it limits the bytes that a damaged length can claim."""

_HEADER, _CHECK = 6, 2
"""Bytes of preamble, id and length; bytes of the checksum."""
_NO_ID = 0xAA
"""No command has this id, so in a run of more than three AA the preamble is the last three."""


class WireError(DeviceError):
    """Invalid bytes: a payload of the wrong length, a number that is not finite, or an unknown status."""


# Packets -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Packet:
    """A command or a reply; id: 0 to 255 except AA; payload: at most MAX_PAYLOAD bytes."""

    id: int
    payload: bytes = b""


_TABLE = tuple(binascii.crc_hqx(bytes([byte]), 0) for byte in range(256))
"""Remainder of each byte by the polynomial 0x1021, most significant bit first."""


def checksum(data: bytes | bytearray) -> int:
    """Return the checksum of `data`: 0 if `data` ends with a valid one. Unlike CCITT, the register shifts right."""
    value = 0xFFFF
    for byte in data:
        value = _TABLE[(value ^ byte) & 0xFF] ^ (value >> 8)
    return value


def encode(packet: Packet) -> bytes:
    """Return the bytes of a packet."""
    body = PREAMBLE + struct.pack("<BH", packet.id, len(packet.payload)) + packet.payload
    return body + struct.pack("<H", checksum(body))


def decode(buffer: bytes | bytearray) -> tuple[int, Packet | None]:
    """Return the number of bytes to drop and the first valid packet, or None if more bytes are needed.

    Invalid bytes are skipped one by one, so a packet that begins inside a damaged one is found. The bytes of an
    incomplete packet are not dropped. If its rest does not arrive, drop one byte and decode again.
    """
    start = buffer.find(PREAMBLE)
    while start >= 0:
        size = _claimed_size(buffer, start)
        if size is None or len(buffer) < start + size:
            return start, None
        if size and checksum(buffer[start : start + size]) == 0:
            return start + size, Packet(buffer[start + 3], bytes(buffer[start + _HEADER : start + size - _CHECK]))
        start = buffer.find(PREAMBLE, start + 1)
    kept = next(size for size in (2, 1, 0) if buffer.endswith(PREAMBLE[:size]))  # it may begin a preamble
    return len(buffer) - kept, None


def _claimed_size(buffer: bytes | bytearray, start: int) -> int | None:
    """Return the size of the packet that begins at `start`, 0 if there is none, None if not yet known."""
    if len(buffer) > start + 3 and buffer[start + 3] == _NO_ID:
        return 0
    if len(buffer) < start + _HEADER:
        return None
    length = buffer[start + 4] | buffer[start + 5] << 8
    return 0 if length > MAX_PAYLOAD else _HEADER + length + _CHECK


# Commands ----------------------------------------------------------------------------------------------------


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
    SET_FORCE_LIMIT = 0x32
    GET_FORCE_LIMIT = 0x33
    SYSTEM_STATE = 0x40
    GRASPING_STATE = 0x41
    OPENING = 0x43
    FORCE = 0x45
    INFO = 0x50
    LIMITS = 0x53


UPDATING = frozenset({CommandId.SYSTEM_STATE, CommandId.GRASPING_STATE, CommandId.OPENING, CommandId.FORCE})
"""Commands whose reply the gripper can send periodically."""


def command_name(command_id: int) -> str:
    """Return the name of a command for messages, such as "GRASP (25h)"."""
    name = CommandId(command_id).name if command_id in list(CommandId) else "to an unknown command"
    return f"{name} ({command_id:02X}h)"


def command(command_id: CommandId, *numbers: float) -> Packet:
    """Build a command with its lengths, speeds or forces."""
    return Packet(command_id, struct.pack(f"<{len(numbers)}f", *numbers))


HOME = Packet(CommandId.HOME, b"\0")
"""The homing command (reference run), in the direction that is set on the gripper's web page."""

ACKNOWLEDGE = Packet(CommandId.ACKNOWLEDGE, b"ack")
"""The command that ends a FAST STOP."""


def move(width_mm: float, speed_mm_s: float) -> Packet:
    """Build the command to pre-position the fingers, which stop (and do not clamp) when blocked."""
    return Packet(CommandId.MOVE, b"\x02" + command(CommandId.MOVE, width_mm, speed_mm_s).payload)


def query(command_id: CommandId) -> Packet:
    """Build the query of a value; for an UPDATING command it also ends the automatic updates."""
    return Packet(command_id, bytes(3) if command_id in UPDATING else b"")


def update(command_id: CommandId, period_ms: int) -> Packet:
    """Build the command for automatic updates of an UPDATING value every `period_ms` (1 to 65535)."""
    return Packet(command_id, struct.pack("<BH", 1, period_ms))


# Replies -----------------------------------------------------------------------------------------------------

Status = enum.IntEnum(
    "Status",
    "SUCCESS NOT_AVAILABLE NO_SENSOR NOT_INITIALIZED ALREADY_RUNNING FEATURE_NOT_SUPPORTED INCONSISTENT_DATA TIMEOUT "
    "READ_ERROR WRITE_ERROR INSUFFICIENT_RESOURCES CHECKSUM_ERROR NO_PARAM_EXPECTED NOT_ENOUGH_PARAMS CMD_UNKNOWN "
    "CMD_FORMAT_ERROR ACCESS_DENIED ALREADY_OPEN CMD_FAILED CMD_ABORTED INVALID_HANDLE NOT_FOUND NOT_OPEN IO_ERROR "
    "INVALID_PARAMETER INDEX_OUT_OF_BOUNDS CMD_PENDING OVERRUN RANGE_ERROR AXIS_BLOCKED FILE_EXISTS",
    start=0,
)
"""Status of a command in its reply, numbered from 0."""

GraspingState = enum.IntEnum(
    "GraspingState", "IDLE GRASPING NO_PART PART_LOST HOLDING RELEASING POSITIONING ERROR", start=0
)
"""State of the grasp as the gripper reports it, numbered from 0."""


class SystemState(enum.IntFlag):
    """Bits of the system state that the driver uses; other bits are preserved."""

    REFERENCED = 1 << 0
    MOVING = 1 << 1
    FAST_STOP = 1 << 12
    TEMPERATURE_WARNING = 1 << 13
    TEMPERATURE_FAULT = 1 << 14
    POWER_FAULT = 1 << 15
    CURRENT_FAULT = 1 << 16
    FINGER_FAULT = 1 << 17
    COMMAND_FAILURE = 1 << 18
    SCRIPT_FAILURE = 1 << 20

    @property
    def faults(self) -> str:
        """The faults as text."""
        faults = self & ~(SystemState.REFERENCED | SystemState.MOVING | SystemState.FAST_STOP)
        named = ", ".join(bit.name or "" for bit in SystemState if bit & faults)
        return named.lower().replace("_", " ") or "no fault flag is set: a stop at the gripper, or a lost link"


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


def reply(packet: Packet) -> tuple[Status, bytes]:
    """Return the status and parameters of a reply; raise WireError if the status is missing or unknown."""
    number = int.from_bytes(packet.payload[:2], "little")
    if len(packet.payload) < 2 or number not in list(Status):
        status = packet.payload[:2].hex(" ") or "none"
        raise WireError(f"the reply {command_name(packet.id)} must have a known status of 2 bytes, got {status}")
    return Status(number), packet.payload[2:]


def number(parameters: bytes) -> float:
    """Parse a length, speed or force; raise WireError if it is not a finite number."""
    return float(_unpack("<f", parameters)[0])


def limits(parameters: bytes) -> GripperLimits:
    """Parse the limits of the gripper."""
    return GripperLimits(*_unpack("<8f", parameters))


def info(parameters: bytes) -> dict[str, int]:
    """Parse the identity of the gripper; kind: the vendor's type number; firmware: one digit for each nibble."""
    return dict(zip(("kind", "hardware", "firmware", "serial"), _unpack("<BBHI", parameters), strict=True))


def system_state(parameters: bytes) -> SystemState:
    """Parse the system state."""
    return SystemState(_unpack("<I", parameters)[0])


def grasping_state(parameters: bytes) -> GraspingState:
    """Parse the state of the grasp."""
    (number,) = _unpack("<B", parameters)
    if number not in list(GraspingState):
        raise WireError(f"a state of the grasp must be from 0 to {max(GraspingState)}, got {number}")
    return GraspingState(number)


def _unpack(form: str, parameters: bytes) -> tuple[Any, ...]:
    if len(parameters) != struct.calcsize(form):
        raise WireError(f"parameters must be {struct.calcsize(form)} bytes, got {len(parameters)}")
    values = struct.unpack(form, parameters)
    if not all(map(math.isfinite, values)):
        raise WireError(f"numbers must be finite, got {values}")
    return values
