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

from robot.sim.contact.kernels import Floats, Operator
from robot.sim.jit import jit_reassociated

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
        run = _Descent(self, start)
        for iteration in range(max_iterations):
            if run.residual <= tolerance:
                return run.solution(iteration, True)
            run.step()
        return run.solution(max_iterations, run.residual <= tolerance)

    def initial_pressure(self) -> Floats:
        """A pressure to start from when nothing better is known: as springs would carry it."""
        if self.load is None:
            return np.maximum(self.depth - self.gap, 0.0) / self.operator.bound
        above = self.gap - self.gap.min()
        there = np.sort(above[np.isfinite(above)])
        # Of a flat punch over all pixels that lie lower than it goes: the depth falls with the root of the area.
        punch = self.operator.peak * self.load / np.sqrt(np.arange(1, there.size + 1))
        springs = np.maximum(float(punch[np.count_nonzero(there < punch) - 1]) - above, 0.0)
        springs = springs if springs.any() else (above == 0.0).astype(np.float64)  # a surface that does not give
        return np.asarray(springs * (self.load / springs.sum()))


class _Descent:
    """One descent: the pressure, what follows from it, and the direction last gone along."""

    def __init__(self, problem: ContactProblem, start: Floats) -> None:
        self.problem = problem
        self.change = np.inf  # relative, of the pressure in the last step
        self.direction, self.previous_squares, self.conjugate = np.zeros_like(start), 1.0, False
        self._accept(*self._measure(np.ascontiguousarray(start), problem.operator(start)))

    def _measure(self, pressure: Floats, displacement: Floats) -> tuple[Floats, Floats, float]:
        """With its energy, which is infinite if nothing is left to carry a load."""
        energy, total = _energy(pressure, displacement, self.problem.gap)
        if self.problem.load is None:
            return pressure, displacement, energy - self.problem.depth * total
        return pressure, displacement, energy if total > 0.0 else math.inf

    def _accept(self, pressure: Floats, displacement: Floats, energy: float) -> None:
        self.pressure, self.displacement, self.energy = pressure, displacement, energy
        self.distance, self.inside = np.empty_like(pressure), np.empty_like(pressure)
        by_load, depth = self.problem.load is not None, self.problem.depth
        self.approach, self.count, self.squares, beside, largest = _contact_state(
            pressure, displacement, self.problem.gap, by_load, depth, self.distance, self.inside
        )
        # What of the largest displacement would be rounding counts for nothing.
        rounding = _ROUNDING * self.problem.operator.bound * float(pressure.max())
        error = max(math.sqrt(self.squares / self.count), beside) / (max(largest, rounding) or 1.0)
        self.residual = max(self.change, GAP_WEIGHT * error)

    def step(self) -> None:
        """Along the conjugate direction; if that raises the energy, by the safe step."""
        before = self.pressure
        pressure, displacement = self._conjugate_step()
        reached = self._measure(pressure, displacement)
        if not reached[2] <= self.energy + self.problem.operator.rounding * abs(self.energy):
            self.conjugate = False
            pressure = self._safe_step()
            reached = self._measure(pressure, self.problem.operator(pressure))
        self.change = _relative_change(before, reached[0])
        self._accept(*reached)

    def _conjugate_step(self) -> tuple[Floats, Floats]:
        """Along the direction to the least energy, then to pressures that are allowed and to the load."""
        beta = self.squares / self.previous_squares if self.conjugate and self.previous_squares > 0.0 else 0.0
        direction = np.empty_like(self.direction)
        slope, total = _conjugate_direction(self.inside, self.pressure, self.direction, beta, direction)
        self.direction, self.previous_squares = direction, self.squares
        moved = self.problem.operator(direction)
        bend, raised = _curvature(moved, direction, self.pressure)
        if self.problem.load is not None:
            bend -= raised / self.count * total
        # 1/bound where the energy does not bend.
        length = slope / bend if bend > 0.0 and slope > 0.0 else 1.0 / self.problem.operator.bound
        pressure = np.empty_like(self.pressure)
        leaving, entering, total = _project_step(self.pressure, direction, self.distance, length, pressure)
        self.conjugate = not entering
        # Back to the load; nothing brings it back if no pressure is left, and the safe step follows.
        factor = 1.0 if self.problem.load is None or total <= 0.0 else self.problem.load / total
        pressure *= factor
        if leaving or entering:
            return pressure, self.problem.operator(pressure)
        return pressure, (self.displacement - length * moved) * factor

    def _safe_step(self) -> Floats:
        """Down the gradient by 1/bound, to the nearest pressure that is allowed."""
        there = np.isfinite(self.problem.gap)
        wanted = self.pressure - np.where(there, self.distance, 0.0) / self.problem.operator.bound
        if self.problem.load is None:
            return np.maximum(wanted, 0.0)
        pressure = np.zeros_like(wanted)
        pressure[there] = project_to_simplex(wanted[there], self.problem.load)
        return pressure

    def solution(self, iterations: int, converged: bool) -> Solution:
        return Solution(self.pressure, self.displacement, self.approach, iterations, float(self.residual), converged)


def project_to_simplex(values: Floats, total: float) -> Floats:
    """The point nearest to `values` (n,) among those >= 0 that add up to `total` > 0 (Held, Wolfe & Crowder 1974)."""
    falling = np.sort(values)[::-1]
    excess = (np.cumsum(falling) - total) / np.arange(1, values.size + 1)
    last = int(np.nonzero(falling > excess)[0][-1])
    return np.asarray(np.maximum(values - excess[last], 0.0))


# One pass over the pixels each ------------------------------------------------------------------------------


@jit_reassociated
def _energy(pressure, displacement, gap):  # type: ignore[no-untyped-def]
    """The energy but for the depth's share, and the sum of pressures; where the gap is infinite there is none."""
    energy, total = 0.0, 0.0
    for row in range(pressure.shape[0]):
        for i in range(pressure.shape[1]):
            p = pressure[row, i]
            energy += p * (0.5 * displacement[row, i] + gap[row, i]) if p > 0.0 else 0.0
            total += p
    return energy, total


@jit_reassociated
def _contact_state(pressure, displacement, gap, by_load, depth, distance, inside):  # type: ignore[no-untyped-def]
    """Fill `distance` (inf where nothing is) and what of it lies `inside` the contact.

    Returns the approach (by load, what makes the mean distance inside 0), the number of pixels inside (at least 1), the
    sum of the squares of their distances, the deepest penetration beside them, and the largest displacement.
    """
    count, total, largest = 0, 0.0, 0.0
    for row in range(pressure.shape[0]):
        for i in range(pressure.shape[1]):
            if pressure[row, i] > 0.0:
                count += 1
                total += displacement[row, i] + gap[row, i]
            size = abs(displacement[row, i])
            largest = size if size > largest else largest
    count = max(count, 1)
    approach = total / count if by_load else depth
    squares, lowest = 0.0, 0.0
    for row in range(pressure.shape[0]):
        for i in range(pressure.shape[1]):
            apart = displacement[row, i] + gap[row, i] - approach
            touching = pressure[row, i] > 0.0
            within = apart if touching else 0.0
            distance[row, i], inside[row, i] = apart, within
            squares += within * within
            below = 0.0 if touching else apart
            lowest = below if below < lowest else lowest
    return approach, count, squares, -lowest, largest


@jit_reassociated
def _conjugate_direction(inside, pressure, before, beta, direction):  # type: ignore[no-untyped-def]
    """Fill `direction` with `inside` + beta times the one before, within the contact; the energy's slope along it, and
    its sum.
    """
    slope, total = 0.0, 0.0
    for row in range(pressure.shape[0]):
        for i in range(pressure.shape[1]):
            along = inside[row, i] + beta * (before[row, i] if pressure[row, i] > 0.0 else 0.0)
            direction[row, i] = along
            slope += inside[row, i] * along
            total += along
    return slope, total


@jit_reassociated
def _curvature(moved, direction, pressure):  # type: ignore[no-untyped-def]
    """How the energy bends along the direction, and the sum of the displacement by it within the contact."""
    bend, raised = 0.0, 0.0
    for row in range(pressure.shape[0]):
        for i in range(pressure.shape[1]):
            bend += moved[row, i] * direction[row, i]
            raised += moved[row, i] if pressure[row, i] > 0.0 else 0.0
    return bend, raised


@jit_reassociated
def _project_step(before, direction, distance, length, pressure):  # type: ignore[no-untyped-def]
    """Fill `pressure` with what lies a step ahead and is allowed; whether pixels leave and enter the contact, and its
    sum.
    """
    leaving, entering, total = 0, 0, 0.0
    for row in range(before.shape[0]):
        for i in range(before.shape[1]):
            p = before[row, i] - length * direction[row, i]
            leaving += p < 0.0
            p = p if p > 0.0 else 0.0
            enters = distance[row, i] < 0.0 and p <= 0.0
            entering += enters
            p = -length * distance[row, i] if enters else p
            pressure[row, i] = p
            total += p
    return leaving > 0, entering > 0, total


@jit_reassociated
def _relative_change(before, pressure):  # type: ignore[no-untyped-def]
    """Of the pressure, relative."""
    change, total = 0.0, 0.0
    for row in range(before.shape[0]):
        for i in range(before.shape[1]):
            change += abs(pressure[row, i] - before[row, i])
            total += pressure[row, i]
    return change / (total if total != 0.0 else 1.0)
