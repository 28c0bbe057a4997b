"""Jaws of the emulated WSG-50: they move in time, and a rigid object may stand between them. No I/O, no commands.

They speed up at the acceleration that is set, brake in time for their target, and stop dead at an object or the end of
the stroke. Lengths in mm, speeds of the jaws towards each other in mm/s, times in s.
"""

import math

STROKE_MM = 110.0
_STEP_S = 0.002
_THERE_MM = 1e-6


class Mechanics:
    """The jaws. object_mm: width of what is between them, or None. opening_mm, speed_mm_s (below 0: closing)."""

    def __init__(self, opening_mm: float = 50.0, object_mm: float | None = None) -> None:
        self.opening_mm, self.object_mm = opening_mm, object_mm
        self.speed_mm_s, self.acceleration_mm_s2 = 0.0, 3000.0
        self.blocked = 0
        """-1 where something keeps the jaws from closing, 1 from opening, 0 where they can move."""
        self._target_mm: float | None = None
        self._top_mm_s = 0.0

    @property
    def moves(self) -> bool:
        """Whether they are on their way."""
        return self._target_mm is not None

    def go(self, target_mm: float, speed_mm_s: float) -> None:
        """Set out for `target_mm`."""
        self._target_mm, self._top_mm_s, self.blocked = target_mm, speed_mm_s, 0

    def stand(self) -> None:
        """Stop dead."""
        self._target_mm, self.speed_mm_s = None, 0.0

    def advance(self, seconds: float) -> None:
        """Let time pass; they stand when they are at the target, or blocked."""
        while seconds > 0 and self.moves:
            step = min(seconds, _STEP_S)
            self._step(step)
            seconds -= step

    def _step(self, seconds: float) -> None:
        assert self._target_mm is not None
        way = self._target_mm - self.opening_mm
        braking = math.sqrt(2 * self.acceleration_mm_s2 * abs(way))
        speed = min(abs(self.speed_mm_s) + self.acceleration_mm_s2 * seconds, self._top_mm_s, max(braking, 1.0))
        self.speed_mm_s = math.copysign(speed, way)
        moved = self.opening_mm + math.copysign(min(speed * seconds, abs(way)), way)
        if self._met(moved):
            self.stand()
            return
        self.opening_mm = moved
        if abs(self._target_mm - moved) < _THERE_MM:
            self.stand()

    def _met(self, moved: float) -> bool:
        """Whether the way to `moved` ends at the object or at the end of the stroke."""
        least = 0.0 if self.object_mm is None else self.object_mm
        if moved < least <= self.opening_mm:
            self.opening_mm, self.blocked = least, -1
        elif moved > STROKE_MM:
            self.opening_mm, self.blocked = STROKE_MM, 1
        return self.blocked != 0
