"""Faults that an emulator injects: their rate, their kinds and their counts."""

import random
import threading
from collections.abc import Sequence
from typing import ClassVar

from robot.errors import RobotConfigError
from robot.settings import check_range


class FaultInjector:
    """Inject faults into a fraction `rate` of the operations, with uniformly drawn `kinds`; `counts` counts them.

    A subclass lists the possible kinds in KINDS. The class is thread-safe. Raises RobotConfigError.
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
        """Return the fault of this operation, one of the possible ones, or None."""
        kinds = [kind for kind in possible if kind in self.kinds]
        with self._lock:
            if not kinds or self._random.random() >= self.rate:
                return None
            kind = self._random.choice(kinds)
            self.counts[kind] += 1
            return kind
