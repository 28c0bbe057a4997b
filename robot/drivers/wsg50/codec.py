"""Packets of the WSG-50's command interface: encoding, checksum, and decoding from a byte stream. No I/O.

A packet is AA AA AA | id u8 | length u16 | payload | checksum u16, all little-endian. Module
robot.drivers.wsg50.commands interprets payloads. Sources: the gripper's command set reference (firmware 4.0) and public
drivers for it.
"""

import functools
import operator
import struct
from dataclasses import dataclass

from robot.errors import DeviceError

PREAMBLE = b"\xaa\xaa\xaa"
MAX_PAYLOAD = 256
"""Longest accepted payload, above that of any command; it limits the bytes that a damaged length can claim."""

_HEADER = 6  # preamble, id, length
_CHECK = 2
_NO_ID = 0xAA
"""No command has this id, so in a run of more than three AA the preamble is the last three."""


class WireError(DeviceError):
    """Invalid bytes: a payload of the wrong length, a number that is not finite, or an unknown status."""


@dataclass(frozen=True)
class Packet:
    """A command or a reply; id: 0 to 255 except AA."""

    id: int
    payload: bytes = b""

    def __post_init__(self) -> None:
        """Raise WireError for an id or a payload that cannot be encoded."""
        if not 0 <= self.id <= 255 or self.id == _NO_ID:
            raise WireError(f"a packet's id must be from 0 to 255 and not {_NO_ID}, got {self.id}")
        if len(self.payload) > MAX_PAYLOAD:
            raise WireError(f"a payload must be at most {MAX_PAYLOAD} bytes, got {len(self.payload)}")


def _table_row(index: int) -> int:
    """Return the remainder of a byte by the polynomial 0x1021, most significant bit first."""
    row = index << 8
    for _ in range(8):
        row = (row << 1) ^ (0x1021 if row & 0x8000 else 0)
    return row & 0xFFFF


_TABLE = tuple(map(_table_row, range(256)))


def checksum(data: bytes | bytearray, start: int = 0xFFFF) -> int:
    """Return the checksum of `data`: 0 if `data` ends with a valid one. Unlike CCITT, the register shifts right."""
    value = start
    for byte in data:
        value = _TABLE[(value ^ byte) & 0xFF] ^ (value >> 8)
    return value


class _PrefixChecksums:
    """Checksums of many ranges of one buffer in a single pass over its bytes.

    In a stream of truncated packets, up to 44 packets claim the same byte. The checksum is linear: that of a range
    follows from the checksums (initial value 0) of all bytes before its start and before its end.
    """

    def __init__(self, buffer: bytes | bytearray, first: int) -> None:
        self._buffer, self._first, self._up_to = buffer, first, [0]

    def checksum_of(self, start: int, stop: int) -> int:
        """Return `checksum(buffer[start:stop])`; start must be at least `first`."""
        value = self._up_to[-1]
        for byte in self._buffer[self._first + len(self._up_to) - 1 : stop]:
            value = _TABLE[(value ^ byte) & 0xFF] ^ (value >> 8)
            self._up_to.append(value)
        begun = 0xFFFF ^ self._up_to[start - self._first]
        return self._up_to[stop - self._first] ^ _after_zeros(begun, stop - start)


def _after_zeros(value: int, count: int) -> int:
    """Return the checksum after `count` further bytes of 0."""
    column = _ZEROS[count]
    return functools.reduce(operator.xor, (column[bit] for bit in range(16) if value >> bit & 1), 0)


def _zeros(max_count: int) -> tuple[tuple[int, ...], ...]:
    """Return rows: entry b of row n is the checksum of n zero bytes from start value 1 << b."""
    columns = [tuple(1 << bit for bit in range(16))]
    for _ in range(max_count):
        columns.append(tuple(_TABLE[value & 0xFF] ^ (value >> 8) for value in columns[-1]))
    return tuple(columns)


_ZEROS = _zeros(_HEADER + MAX_PAYLOAD + _CHECK)


def encode(packet: Packet) -> bytes:
    """Return the bytes of a packet."""
    body = PREAMBLE + struct.pack("<BH", packet.id, len(packet.payload)) + packet.payload
    return body + struct.pack("<H", checksum(body))


def decode(buffer: bytes | bytearray) -> tuple[int, Packet | None]:
    """Return the number of bytes to drop and the first valid packet, or None if more bytes are needed.

    Invalid bytes are skipped one by one, so a packet that begins inside a damaged one is found. The bytes of an
    incomplete packet are not dropped. If its rest does not arrive, drop one byte and decode again.
    """
    at = buffer.find(PREAMBLE)
    sums = _PrefixChecksums(buffer, at)
    while at >= 0:
        size = _claimed_size(buffer, at)
        if size is None or (size and len(buffer) < at + size):
            return at, None
        if size and sums.checksum_of(at, at + size) == 0:
            payload = bytes(buffer[at + _HEADER : at + size - _CHECK])
            return at + size, Packet(buffer[at + 3], payload)
        at = buffer.find(PREAMBLE, at + 1)
    return len(buffer) - _partial_preamble_size(buffer), None


def _claimed_size(buffer: bytes | bytearray, at: int) -> int | None:
    """Return the size of the packet that begins at `at`, 0 if there is none, None if not yet known."""
    if len(buffer) > at + 3 and buffer[at + 3] == _NO_ID:
        return 0
    if len(buffer) < at + _HEADER:
        return None
    length = buffer[at + 4] | buffer[at + 5] << 8
    return 0 if length > MAX_PAYLOAD else _HEADER + length + _CHECK


def _partial_preamble_size(buffer: bytes | bytearray) -> int:
    """Return the number of bytes at the end that may begin a preamble."""
    return next(size for size in (2, 1, 0) if size == 0 or buffer[-size:] == PREAMBLE[:size])
