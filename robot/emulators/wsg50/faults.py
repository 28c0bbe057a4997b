"""Faults for the line of an emulated WSG-50: packets lost, doubled, damaged, late, in pieces, misnamed; the line cut.

A line is a stream: what is late keeps everything behind it waiting, and nothing overtakes.
"""

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from robot.drivers.wsg50.codec import Packet, WireError, encode
from robot.errors import RobotConfigError
from robot.settings import check_range

KINDS = ("dropped", "duplicated", "corrupted", "delayed", "split", "wrong id", "disconnect")


@dataclass(frozen=True)
class Piece:
    """Bytes for the line, after a pause; None cuts it."""

    data: bytes | None
    pause_s: float = 0.0


class Faults:
    """Damages packets. rate: share of packets that meet a fault, each of a kind of `kinds` drawn evenly.

    delay_s: how late a delayed packet is, and the pause within a split one. counts: faults made so far, by kind.
    Raises RobotConfigError.
    """

    def __init__(
        self, rate: float = 0.0, kinds: Sequence[str] = KINDS, *, seed: int = 0, delay_s: float = 0.05
    ) -> None:
        if unknown := sorted(set(kinds) - set(KINDS)):
            raise RobotConfigError(f"faults must be of {', '.join(KINDS)}; got {unknown[0]!r}")
        check_range("the rate of faults", rate, 0, 1)
        self.rate, self.kinds, self.delay_s = rate, tuple(kinds), delay_s
        self.counts = dict.fromkeys(self.kinds, 0)
        self._random = random.Random(seed)

    def on(self, packet: Packet) -> Iterator[Piece]:
        """What becomes of a packet on the line."""
        data = encode(packet)
        if not self.kinds or self._random.random() >= self.rate:
            yield Piece(data)
            return
        kind = self._random.choice(self.kinds)
        self.counts[kind] += 1
        yield from self._damaged(kind, packet, data)

    def _damaged(self, kind: str, packet: Packet, data: bytes) -> Iterator[Piece]:
        if kind == "duplicated":
            yield Piece(data + data)
        elif kind == "corrupted":
            yield Piece(self._flipped(data))
        elif kind == "delayed":
            yield Piece(data, self.delay_s)
        elif kind == "split":
            cut = self._random.randrange(1, len(data))
            yield Piece(data[:cut])
            yield Piece(data[cut:], self.delay_s)
        elif kind == "wrong id":
            yield Piece(self._misnamed(packet))
        elif kind == "disconnect":
            yield Piece(None)

    def _flipped(self, data: bytes) -> bytes:
        damaged = bytearray(data)
        damaged[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
        return bytes(damaged)

    def _misnamed(self, packet: Packet) -> bytes:
        """The same packet with another id, and a check sum that fits."""
        while True:
            try:
                other = Packet(self._random.randrange(256), packet.payload)
            except WireError:
                continue
            if other.id != packet.id:
                return encode(other)
