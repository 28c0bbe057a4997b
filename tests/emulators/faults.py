"""Faults that an emulator makes on purpose: how often, which, and how many so far."""

import random
import threading
from collections.abc import Sequence
from typing import ClassVar

from robot.errors import RobotConfigError
from robot.settings import check_range


class FaultInjector:
    """Something goes wrong in a share `rate` of the operations, of `kinds` drawn evenly; `counts` says how often what.

    A subclass says in KINDS what can go wrong. Safe in several threads. Raises RobotConfigError.
    """

    KINDS: ClassVar[tuple[str, ...]]

    def __init__(self, rate: float = 0.0, kinds: Sequence[str] | None = None, *, seed: int = 0) -> None:
        self.rate, self.kinds = rate, self.KINDS if kinds is None else tuple(kinds)
        if unknown := sorted(set(self.kinds) - set(self.KINDS)):
            raise RobotConfigError(f"faults must be of {', '.join(self.KINDS)}; got {unknown[0]!r}")
        check_range("the rate of faults", rate, 0, 1)
        self.counts = dict.fromkeys(self.kinds, 0)
        self._random, self._lock = random.Random(seed), threading.Lock()

    def draw(self, possible: Sequence[str]) -> str | None:
        """The fault of this operation, of those possible, or None."""
        kinds = [kind for kind in possible if kind in self.kinds]
        with self._lock:
            if not kinds or self._random.random() >= self.rate:
                return None
            kind = self._random.choice(kinds)
            self.counts[kind] += 1
            return kind
