"""Jaws of the emulated WSG-50: they move in time, with or without a rigid object in between. No I/O, no commands.

They accelerate as set, brake before their target, and stop immediately at an object or at the end of the stroke.
Lengths are in mm, speeds of the jaws towards each other in mm/s, times in s.
"""

import math

STROKE_MM = 110.0
_STEP_S = 0.002
_THERE_MM = 1e-6


class Mechanics:
    """The jaws.

    Attributes:
        opening_mm: Distance of the jaws.
        object_mm: Width of the object between them, or None.
        speed_mm_s: Speed; negative while closing.
        blocked: -1 if something keeps the jaws from closing, 1 from opening, 0 if they can move.
    """

    def __init__(self, opening_mm: float = 50.0, object_mm: float | None = None) -> None:
        self.opening_mm, self.object_mm = opening_mm, object_mm
        self.speed_mm_s, self.acceleration_mm_s2 = 0.0, 3000.0
        self.blocked = 0
        self._target_mm: float | None = None
        self._top_mm_s = 0.0

    @property
    def moves(self) -> bool:
        """Whether they move."""
        return self._target_mm is not None

    def go(self, target_mm: float, speed_mm_s: float) -> None:
        """Start to move to `target_mm`."""
        self._target_mm, self._top_mm_s, self.blocked = target_mm, speed_mm_s, 0

    def stand(self) -> None:
        """Stop immediately."""
        self._target_mm, self.speed_mm_s = None, 0.0

    def advance(self, seconds: float) -> None:
        """Let time pass; they stop at the target or if they are blocked."""
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
        """Stop at the object or at the end of the stroke; return whether the jaws are blocked."""
        minimum = 0.0 if self.object_mm is None else self.object_mm
        if moved < minimum <= self.opening_mm:
            self.opening_mm, self.blocked = minimum, -1
        elif moved > STROKE_MM:
            self.opening_mm, self.blocked = STROKE_MM, 1
        return self.blocked != 0
