"""How long the stages of an answer take."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Milliseconds of named stages and in total."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._stages: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self._stages[stage] = self._stages.get(stage, 0.0) + 1e3 * (time.perf_counter() - start)

    def finished(self, shares: int) -> dict[str, float]:
        """One of so many equal shares: of the stages in their order, and of "total" since it was made."""
        everything = {**self._stages, "total": 1e3 * (time.perf_counter() - self._start)}
        return {stage: ms / shares for stage, ms in everything.items()}
