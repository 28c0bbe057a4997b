"""Pressure between an elastic surface and a height map: a quadratic programme, by constrained conjugate gradients.

    minimise  1/2 p.K p + p.gap  over p >= 0,  with sum p = load (force control) or less depth sum p (depth control)

Polonsky & Keer, Wear 231 (1999) 206, with three changes. Their energy may rise, and then the iteration can cycle for
ever (a pin that gives way to the plate around it): here a step that raises it is taken back, and a projected gradient
step of length 1/bound is made instead, which always lowers it. A contact set of one pixel has no direction to go along;
that step stands in there too. And where no pixel enters or leaves the contact, K p follows without another product.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from robot.sim.contact.kernels import Floats, Operator

# The contact conditions are held tighter than the pressure: a displacement is seen, a pressure is not.
GAP_WEIGHT = 20.0
_ROUNDING = 1e-12  # relative; what is smaller is not told from rounding


@dataclass(frozen=True)
class Solution:
    """Scaled pressure and K p, both (rows, cols), the approach, and how they were reached.

    `residual` is the largest of: relative change of pressure in the last step; GAP_WEIGHT times the root mean square
    of the gap within the contact, and times the deepest penetration beside it, both over the largest displacement.
    """

    pressure: Floats
    displacement: Floats
    approach: float
    iterations: int
    residual: float
    converged: bool


@dataclass(frozen=True)
class ContactProblem:
    """`gap` (rows, cols), +inf where there is nothing; `load` None for depth control."""

    operator: Operator
    gap: Floats
    load: float | None = None
    depth: float = 0.0

    def solve(self, start: Floats, tolerance: float, max_iterations: int) -> Solution:
        """From `start`, a pressure of the right sum that is zero wherever the gap is infinite."""
        run = _Run(self, start)
        for iteration in range(max_iterations):
            if run.residual <= tolerance:
                return run.solution(iteration, True)
            run.step()
        return run.solution(max_iterations, run.residual <= tolerance)

    def guess(self) -> Floats:
        """A pressure to start from when nothing better is known: as springs would carry it."""
        if self.load is None:
            return np.maximum(self.depth - self.gap, 0.0) / self.operator.bound
        above = self.gap - self.gap.min()
        springs = np.maximum(self._guessed_depth(above[np.isfinite(above)], self.load) - above, 0.0)
        springs = springs if springs.any() else (above == 0.0).astype(np.float64)  # a surface that does not give
        return np.asarray(springs * (self.load / springs.sum()))

    def _guessed_depth(self, above: Floats, load: float) -> float:
        """Of a flat punch over all pixels that lie lower than it goes: the depth falls with the root of the area."""
        punch = self.operator.peak * load / np.sqrt(np.arange(1, above.size + 1))
        return float(punch[np.count_nonzero(np.sort(above) < punch) - 1])


def _dot(a: Floats, b: Floats) -> float:
    """Not BLAS's: that shares the sum among threads, which costs more than it saves and lets their number show."""
    return float(np.einsum("ij,ij->", a, b))


class _Run:
    """One descent: the pressure, what follows from it, and the direction last gone along."""

    def __init__(self, problem: ContactProblem, start: Floats) -> None:
        self.problem = problem
        self.there = np.isfinite(problem.gap)
        self.gap = np.where(self.there, problem.gap, 0.0)
        self.change = np.inf  # relative, of the pressure in the last step
        self.direction, self.squares, self.conjugate = np.zeros_like(start), 1.0, False
        self._accept(*self._measure(start, problem.operator(start)))

    def _measure(self, pressure: Floats, displacement: Floats) -> tuple[Floats, Floats, float]:
        """With its energy, which is infinite if nothing is left to carry a load."""
        energy = 0.5 * _dot(pressure, displacement) + _dot(pressure, self.gap)
        total = float(pressure.sum())
        if self.problem.load is None:
            return pressure, displacement, energy - self.problem.depth * total
        return pressure, displacement, energy if total > 0.0 else math.inf

    def _accept(self, pressure: Floats, displacement: Floats, energy: float) -> None:
        self.pressure, self.displacement, self.energy = pressure, displacement, energy
        self.contact: npt.NDArray[np.bool_] = pressure > 0.0
        self.count = max(int(np.count_nonzero(self.contact)), 1)
        distance = displacement + self.gap
        self.approach = self.problem.depth if self.problem.load is None else self._mean(distance)
        distance -= self.approach
        distance[~self.there] = np.inf
        self.distance, self.inside = distance, np.where(self.contact, distance, 0.0)
        self.residual = max(self.change, GAP_WEIGHT * self._gap_error())

    def _mean(self, values: Floats) -> float:
        return float(values[self.contact].sum()) / self.count

    def _gap_error(self) -> float:
        """Of the contact conditions, over the largest displacement (or what of it would be rounding)."""
        rounding = _ROUNDING * self.problem.operator.bound * float(self.pressure.max())
        scale = max(float(np.abs(self.displacement).max()), rounding) or 1.0
        inside = math.sqrt(_dot(self.inside, self.inside) / self.count)
        beside = -float(np.min(self.distance, where=~self.contact, initial=0.0))
        return max(inside, beside) / scale

    def step(self) -> None:
        """Along the conjugate direction; if that raises the energy, by the safe step."""
        before = self.pressure
        pressure, displacement = self._conjugate_step()
        reached = self._measure(pressure, displacement)
        if not reached[2] <= self.energy + _ROUNDING * abs(self.energy):
            self.conjugate = False
            pressure = self._safe_step()
            reached = self._measure(pressure, self.problem.operator(pressure))
        self.change = float(np.abs(reached[0] - before).sum() / (reached[0].sum() or 1.0))
        self._accept(*reached)

    def _conjugate_step(self) -> tuple[Floats, Floats]:
        squares = _dot(self.inside, self.inside)
        beta = squares / self.squares if self.conjugate and self.squares > 0.0 else 0.0
        self.direction = self.inside + beta * np.where(self.contact, self.direction, 0.0)
        self.squares = squares
        moved = self.problem.operator(self.direction)
        length = self._length(moved)
        pressure = self.pressure - length * self.direction
        leaving = pressure.min() < 0.0
        if leaving:
            np.maximum(pressure, 0.0, out=pressure)
        entering = (self.distance < 0.0) & (pressure <= 0.0)
        self.conjugate = not entering.any()
        pressure[entering] -= length * self.distance[entering]
        factor = self._factor(pressure)
        pressure *= factor
        if leaving or not self.conjugate:
            return pressure, self.problem.operator(pressure)
        return pressure, (self.displacement - length * moved) * factor

    def _length(self, moved: Floats) -> float:
        """Of the step that minimises the energy along the direction; 1/bound where the energy does not bend."""
        bend = _dot(moved, self.direction)
        if self.problem.load is not None:
            bend -= self._mean(moved) * float(self.direction.sum())
        slope = _dot(self.inside, self.direction)
        return slope / bend if bend > 0.0 and slope > 0.0 else 1.0 / self.problem.operator.bound

    def _factor(self, pressure: Floats) -> float:
        """What brings the pressure back to the load; nothing does if none is left, and the safe step follows."""
        total = float(pressure.sum())
        return 1.0 if self.problem.load is None or total <= 0.0 else self.problem.load / total

    def _safe_step(self) -> Floats:
        """Down the gradient by 1/bound, to the nearest pressure that is allowed."""
        wanted = self.pressure - np.where(self.there, self.distance, 0.0) / self.problem.operator.bound
        if self.problem.load is None:
            return np.maximum(wanted, 0.0)
        pressure = np.zeros_like(wanted)
        pressure[self.there] = nearest_of_sum(wanted[self.there], self.problem.load)
        return pressure

    def solution(self, iterations: int, converged: bool) -> Solution:
        return Solution(self.pressure, self.displacement, self.approach, iterations, float(self.residual), converged)


def nearest_of_sum(values: Floats, total: float) -> Floats:
    """The point nearest to `values` (n,) among those >= 0 that add up to `total` > 0 (Held, Wolfe & Crowder 1974)."""
    falling = np.sort(values)[::-1]
    excess = (np.cumsum(falling) - total) / np.arange(1, values.size + 1)
    last = int(np.nonzero(falling > excess)[0][-1])
    return np.asarray(np.maximum(values - excess[last], 0.0))
