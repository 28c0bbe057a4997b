"""Faults of the line of an emulated WSG-50: lost, damaged, late and split packets, and cuts.

A line is a stream: a late packet delays all packets behind it, and the order never changes.
"""

import random
import threading
from collections import Counter

from robot.drivers.wsg50.codec import encode

DELAY_S = 0.05
KINDS = ("dropped", "corrupted", "delayed", "split", "disconnect")


class LineFaults:
    """Damages a fraction `rate` of the packets, and those of a plan; `counts` counts the kinds. Thread-safe."""

    def __init__(self, rate=0.0, *, seed=0):
        self.rate, self.counts = rate, Counter()
        self._random, self._lock = random.Random(seed), threading.Lock()
        self.tell({})

    def tell(self, plan):
        """Set the plan: (id, number of the packet with this id from now on) -> kind of damage, or id -> kind for all.

        Commands and replies count together: 1 is the command, 2 its first reply.
        """
        self._plan, self._numbers = plan, Counter()

    def on(self, packet):
        """Return the pieces of a packet on the line, each with the pause in s before it; None cuts the line."""
        with self._lock:
            self._numbers[packet.id] += 1
            kind = self._plan.get((packet.id, self._numbers[packet.id])) or self._plan.get(packet.id)
            if kind is None and self._random.random() < self.rate:
                kind = self._random.choice(KINDS)
            if kind is not None:
                self.counts[kind] += 1
            return self._damaged(kind, encode(packet))

    def _damaged(self, kind, data):
        if kind == "dropped":
            return []
        if kind == "corrupted":
            number = self._random.randrange(8 * len(data))
            return [(0, bytes(byte ^ (at == number // 8) << number % 8 for at, byte in enumerate(data)))]
        if kind == "delayed":
            return [(DELAY_S, data)]
        if kind == "split":
            cut = self._random.randrange(1, len(data))
            return [(0, data[:cut]), (DELAY_S, data[cut:])]
        if kind == "disconnect":
            return [(0, None)]
        if kind == "long":  # claims 255 bytes, so the next packets are read as its payload
            return [(0, data[:4] + b"\xff\x00" + data[6:])]
        return [(0, data)]
