"""Faults of the line of an emulated WSG-50: lost, damaged, late and split packets, and cuts.

A line is a stream: a late packet delays all packets behind it, and the order never changes.
"""

import random
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from robot.drivers.wsg50.codec import Packet, encode


@dataclass(frozen=True)
class Piece:
    """Bytes for the line after a pause; None cuts the line."""

    data: bytes | None
    pause_s: float = 0.0


class LineFaults:
    """Damages a fraction `rate` of the packets, with uniformly drawn `kinds`; `counts` counts them. Thread-safe.

    `delay_s` is the delay of a delayed packet, and the pause within a split one.
    """

    KINDS = ("dropped", "corrupted", "delayed", "split", "disconnect")

    def __init__(
        self, rate: float = 0.0, kinds: Sequence[str] | None = None, *, seed: int = 0, delay_s: float = 0.05
    ) -> None:
        self.rate, self.kinds, self.delay_s = rate, tuple(kinds or self.KINDS), delay_s
        self.counts = dict.fromkeys(self.kinds, 0)
        self._random, self._lock = random.Random(seed), threading.Lock()

    def on(self, packet: Packet) -> Iterator[Piece]:
        """Yield the pieces of a packet on the line."""
        kind, data = None, encode(packet)
        with self._lock:
            if self._random.random() < self.rate:
                kind = self._random.choice(self.kinds)
                self.counts[kind] += 1
        yield from self._damaged(kind, data) if kind else [Piece(data)]

    def _damaged(self, kind: str, data: bytes) -> Iterator[Piece]:
        if kind == "corrupted":
            damaged = bytearray(data)
            damaged[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
            yield Piece(bytes(damaged))
        elif kind == "delayed":
            yield Piece(data, self.delay_s)
        elif kind == "split":
            cut = self._random.randrange(1, len(data))
            yield Piece(data[:cut])
            yield Piece(data[cut:], self.delay_s)
        elif kind == "disconnect":
            yield Piece(None)
