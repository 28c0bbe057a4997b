"""Faults of the line of an emulated WSG-50: late and split packets, missing answers, and cuts.

A line is a stream: a late packet delays all packets behind it, and the order never changes.
"""

import random
import threading
from collections import Counter

from robot.drivers.wsg50.codec import encode

DELAY_S = 0.05
KINDS = ("dropped", "delayed", "split", "disconnect")


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
        cut = self._random.randrange(1, len(data))
        return {
            None: [(0, data)],
            "dropped": [],
            "delayed": [(DELAY_S, data)],
            "split": [(0, data[:cut]), (DELAY_S, data[cut:])],
            "disconnect": [(0, None)],
        }[kind]
