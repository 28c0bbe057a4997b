"""Pressure between an elastic surface and a height map: a quadratic programme, by constrained conjugate gradients.

    minimise  1/2 p.K p + p.gap  over p >= 0,  with sum p = load (force control) or less depth sum p (depth control)

Polonsky & Keer, Wear 231 (1999) 206, with three changes. In their method the energy may rise, and then the iteration
can cycle forever (a pin that gives way to the plate around it). Here a step that raises the energy is undone and
replaced by a projected gradient step of length 1/bound, which always lowers it. A contact set of one pixel has no
search direction; the same step replaces it. If no pixel enters or leaves the contact, K p is updated without another
product.
"""

import math
from dataclasses import dataclass

import numpy as np

from robot.sim.contact.kernels import Floats, Operator
from robot.sim.jit import jit_reassociated

# The contact conditions have a tighter tolerance than the pressure: images show displacement, not pressure.
GAP_WEIGHT = 20.0
_ROUNDING = 1e-12  # relative; smaller values are rounding errors


@dataclass(frozen=True)
class Solution:
    """Solution in scaled units, with its convergence.

    Attributes:
        pressure: (rows, cols) pressure p.
        displacement: (rows, cols) displacement K p.
        approach: approach of the undeformed object.
        iterations: number of steps.
        residual: the largest of: relative change of pressure in the last step; GAP_WEIGHT times the root mean square of
            the gap within the contact; GAP_WEIGHT times the deepest penetration outside it. The last two are relative
            to the largest displacement.
        converged: whether the residual is at most the tolerance.
    """

    pressure: Floats
    displacement: Floats
    approach: float
    iterations: int
    residual: float
    converged: bool


@dataclass(frozen=True)
class ContactProblem:
    """Contact of a height map with an elastic surface: a `load`, the sum of the pressures, or None and a `depth`.

    `gap` (rows, cols) is the distance of the undeformed object, +inf where there is no object.
    """

    operator: Operator
    gap: Floats
    load: float | None = None
    depth: float = 0.0

    def solve(self, start: Floats, tolerance: float, max_iterations: int) -> Solution:
        """Solve from a start pressure with the right sum that is zero wherever the gap is infinite."""
        descent, iterations = _Descent(self, start), 0
        while not descent.residual <= tolerance and iterations < max_iterations:
            descent.step()
            iterations += 1
        residual = float(descent.residual)
        state = descent.pressure, descent.displacement, descent.approach
        return Solution(*state, iterations, residual, residual <= tolerance)

    def initial_pressure(self) -> Floats:
        """Return a start pressure: that of independent springs."""
        if self.load is None:
            return np.maximum(self.depth - self.gap, 0.0) / self.operator.bound
        above = self.gap - self.gap.min()
        there = np.sort(above[np.isfinite(above)])
        # Flat punch over all pixels below its depth: the depth falls with the root of the area.
        punch = self.operator.peak * self.load / np.sqrt(np.arange(1, there.size + 1))
        springs = np.maximum(float(punch[np.count_nonzero(there < punch) - 1]) - above, 0.0)
        springs = springs if springs.any() else (above == 0.0).astype(np.float64)  # a rigid surface
        return np.asarray(springs * (self.load / springs.sum()))


class _Descent:
    """State of the iteration: the pressure, the quantities that depend on it, and the last search direction."""

    def __init__(self, problem: ContactProblem, start: Floats) -> None:
        self.problem = problem
        self.change = np.inf  # relative change of pressure in the last step
        self.direction, self.previous_squares, self.conjugate = np.zeros_like(start), 1.0, False
        self._accept(*self._measure(np.ascontiguousarray(start), problem.operator(start)))

    def _measure(self, pressure: Floats, displacement: Floats) -> tuple[Floats, Floats, float]:
        """Return the arguments with their energy, which is infinite if no pressure remains to carry a load."""
        energy, total = _energy(pressure, displacement, self.problem.gap)
        if self.problem.load is None:
            return pressure, displacement, energy - self.problem.depth * total
        return pressure, displacement, energy if total > 0.0 else math.inf

    def _accept(self, pressure: Floats, displacement: Floats, energy: float) -> None:
        self.pressure, self.displacement, self.energy = pressure, displacement, energy
        self.distance, self.inside = np.empty_like(pressure), np.empty_like(pressure)
        by_load, depth = self.problem.load is not None, self.problem.depth
        self.approach, self.count, self.squares, penetration, largest = _contact_state(
            pressure, displacement, self.problem.gap, by_load, depth, self.distance, self.inside
        )
        # Ignore rounding errors in the largest displacement.
        rounding = _ROUNDING * self.problem.operator.bound * float(pressure.max())
        error = max(math.sqrt(self.squares / self.count), penetration) / (max(largest, rounding) or 1.0)
        self.residual = max(self.change, GAP_WEIGHT * error)

    def step(self) -> None:
        """Step along the conjugate direction; if that raises the energy, take the safe step instead."""
        before = self.pressure
        pressure, displacement = self._conjugate_step()
        state = self._measure(pressure, displacement)
        if not state[2] <= self.energy + self.problem.operator.rounding * abs(self.energy):
            self.conjugate = False
            pressure = self._safe_step()
            state = self._measure(pressure, self.problem.operator(pressure))
        self.change = float(np.abs(state[0] - before).sum()) / (float(state[0].sum()) or 1.0)
        self._accept(*state)

    def _conjugate_step(self) -> tuple[Floats, Floats]:
        """Step along the conjugate direction to the least energy, then project to feasible pressures and the load."""
        beta = self.squares / self.previous_squares if self.conjugate and self.previous_squares > 0.0 else 0.0
        direction = np.empty_like(self.direction)
        slope, total = _conjugate_direction(self.inside, self.pressure, self.direction, beta, direction)
        self.direction, self.previous_squares = direction, self.squares
        moved = self.problem.operator(direction)
        curvature, raised = _curvature(moved, direction, self.pressure)
        if self.problem.load is not None:
            curvature -= raised / self.count * total
        # 1/bound if the curvature is not positive.
        length = slope / curvature if curvature > 0.0 and slope > 0.0 else 1.0 / self.problem.operator.bound
        pressure = np.empty_like(self.pressure)
        leaving, entering, total = _project_step(self.pressure, direction, self.distance, length, pressure)
        self.conjugate = not entering
        # Rescale to the load. If no pressure is left, this is impossible, and the safe step follows.
        factor = 1.0 if self.problem.load is None or total <= 0.0 else self.problem.load / total
        pressure *= factor
        if leaving or entering:
            return pressure, self.problem.operator(pressure)
        return pressure, (self.displacement - length * moved) * factor

    def _safe_step(self) -> Floats:
        """Step down the gradient by 1/bound, then project to the nearest feasible pressure."""
        has_object = np.isfinite(self.problem.gap)
        target = self.pressure - np.where(has_object, self.distance, 0.0) / self.problem.operator.bound
        if self.problem.load is None:
            return np.maximum(target, 0.0)
        pressure = np.zeros_like(target)
        pressure[has_object] = project_to_simplex(target[has_object], self.problem.load)
        return pressure


def project_to_simplex(values: Floats, total: float) -> Floats:
    """Return the point nearest to `values` (n,) with entries >= 0 and sum `total` > 0 (Held, Wolfe & Crowder 1974)."""
    falling = np.sort(values)[::-1]
    excess = (np.cumsum(falling) - total) / np.arange(1, values.size + 1)
    last = int(np.nonzero(falling > excess)[0][-1])
    return np.asarray(np.maximum(values - excess[last], 0.0))


# Each function makes one pass over the pixels ---------------------------------------------------------------


@jit_reassociated
def _energy(pressure, displacement, gap):  # type: ignore[no-untyped-def]
    """Return the energy without the depth term, and the sum of pressures; pixels of infinite gap add nothing."""
    energy, total = 0.0, 0.0
    for row in range(pressure.shape[0]):
        for i in range(pressure.shape[1]):
            p = pressure[row, i]
            energy += p * (0.5 * displacement[row, i] + gap[row, i]) if p > 0.0 else 0.0
            total += p
    return energy, total


@jit_reassociated
def _contact_state(pressure, displacement, gap, by_load, depth, distance, inside):  # type: ignore[no-untyped-def]
    """Fill `distance` (inf where there is no object) and `inside`, the distance within the contact.

    Returns:
        The approach (by load: it makes the mean distance inside 0), the number of pixels inside (at least 1), the sum
            of squares of their distances, the deepest penetration outside, and the largest displacement.
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
    """Fill `direction` with `inside` + beta times the last one, within the contact.

    Returns:
        The slope of the energy along `direction`, and the sum of `direction`.
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
    """Return the curvature of the energy along the direction, and the sum of its displacement within the contact."""
    curvature, raised = 0.0, 0.0
    for row in range(pressure.shape[0]):
        for i in range(pressure.shape[1]):
            curvature += moved[row, i] * direction[row, i]
            raised += moved[row, i] if pressure[row, i] > 0.0 else 0.0
    return curvature, raised


@jit_reassociated
def _project_step(before, direction, distance, length, pressure):  # type: ignore[no-untyped-def]
    """Fill `pressure` with the feasible pressure one step ahead.

    Returns:
        Whether pixels leave the contact, whether pixels enter it, and the sum of `pressure`.
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
