"""The contact problem in scaled units (pixel 1, E* of the gel 1): coarse grid first, then a window around the contact.

Influences do not wrap around, so a window of the grid is exact if nothing outside it touches. The whole field is
checked at the end, and the window grows if the object touches outside it.
"""

import functools
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from robot.sim.contact.constrained_cg import GAP_WEIGHT, ContactProblem, Solution
from robot.sim.contact.kernels import Floats, Operator, Quadrant, influence

_COARSENING = 4
_MIN_NESTED_PIXELS = 48  # along the shorter side; below this a coarser grid saves nothing
_MARGIN = 2  # pixels around the coarse grid's contact
_COARSE_CAP = 40  # iterations on the coarse grid, which only gives a start pressure
_WINDOW_STEPS = 8  # a window's sides are multiples of 1/8 of the grid's, so few operators are cached

Mask = npt.NDArray[np.bool_]
Window = tuple[slice, slice]
_EVERYTHING: Window = (slice(None), slice(None))


@dataclass(frozen=True)
class ElasticSurface:
    """An elastic layer, `thickness` pixels thick, under an elastic object; products in float32 if `single_precision`.

    `softness` is E* of the layer over E* of the object, 0 for a rigid object.
    """

    thickness: float
    poisson: float
    softness: float
    single_precision: bool = False

    def gel_operator(self, grid: Quadrant, window: Quadrant) -> Operator:
        """Return the displacement of the gel by a pressure on a window of the grid."""
        return _operator(grid, window, self.thickness, self.poisson, self.single_precision)

    def combined_operator(self, grid: Quadrant, window: Quadrant) -> Operator:
        """Return the displacement of the gel plus that of the object, a half-space."""
        gel_operator = self.gel_operator(grid, window)
        if self.softness == 0.0:
            return gel_operator
        # A half-space in scaled units does not depend on Poisson's ratio, so all gels share the operator.
        half_space = _operator(grid, window, math.inf, 0.0, self.single_precision)
        return gel_operator.plus(half_space, self.softness)


@functools.lru_cache(maxsize=128)
def _operator(grid: Quadrant, window: Quadrant, thickness: float, poisson: float, single_precision: bool) -> Operator:
    return Operator(influence(grid, thickness, poisson), window, single_precision=single_precision)


@dataclass(frozen=True)
class ScaledProblem:
    """A press in scaled units; `gap`, `load` and `depth` are those of ContactProblem.

    `tolerance` is an upper bound on the residual, `max_iterations` the maximum number of steps on the fine grid.
    """

    surface: ElasticSurface
    gap: Floats
    load: float | None
    depth: float
    tolerance: float
    max_iterations: int

    def solve(self) -> Solution:
        """Solve, starting from the coarse grid's pressure if the grid is large enough."""
        start = self._coarse_start() if min(self.gap.shape) >= _MIN_NESTED_PIXELS else None
        return self._refine(self._problem(_EVERYTHING).initial_pressure() if start is None else start)

    def _problem(self, window: Window) -> ContactProblem:
        gap = np.ascontiguousarray(self.gap[window])
        return ContactProblem(self.surface.combined_operator(self.gap.shape, gap.shape), gap, self.load, self.depth)

    def _coarse_start(self) -> Floats | None:
        """Return the coarse grid's pressure on the fine grid; None if the coarse grid does not touch."""
        gap = coarsen(self.gap) / _COARSENING
        load = None if self.load is None else self.load / _COARSENING**2
        surface = replace(self.surface, thickness=self.surface.thickness / _COARSENING)
        coarse = replace(
            self, surface=surface, gap=gap, load=load, depth=self.depth / _COARSENING, max_iterations=_COARSE_CAP
        )
        if load is None and gap.min() >= coarse.depth:
            return None
        rows, cols = (n * _COARSENING for n in gap.shape)
        pressure = cv2.resize(coarse.solve().pressure, (cols, rows), interpolation=cv2.INTER_LINEAR)
        pressure = np.where(np.isfinite(self.gap), pressure[: self.gap.shape[0], : self.gap.shape[1]], 0.0)
        total = float(pressure.sum())
        return pressure if self.load is None or total <= 0.0 else pressure * (self.load / total)

    def _refine(self, start: Floats) -> Solution:
        """Solve on a window around `start` and enlarge it until nothing touches outside it."""
        active, iterations = start > 0.0, 0
        while True:
            window = _padded_span(np.asarray(active.any(axis=1))), _padded_span(np.asarray(active.any(axis=0)))
            part = self._problem(window).solve(start[window], self.tolerance, self.max_iterations - iterations)
            iterations += part.iterations
            solution, missed = self._extend_to_grid(part, window)
            if not part.converged or not missed.any():
                return replace(solution, iterations=iterations)
            active, start = (solution.pressure > 0.0) | missed, solution.pressure

    def _extend_to_grid(self, part: Solution, window: Window) -> tuple[Solution, Mask]:
        """Extend the window's solution to the whole field; also return where the object touches outside the window."""
        pressure, missed = np.zeros(self.gap.shape), np.zeros(self.gap.shape, bool)
        pressure[window] = part.pressure
        if part.pressure.size == pressure.size:
            return part, missed
        displacement = self._problem(_EVERYTHING).operator(pressure)
        distance = displacement + self.gap - part.approach
        distance[window] = 0.0
        scale = float(np.abs(displacement).max()) or 1.0
        deepest = GAP_WEIGHT * max(0.0, -float(distance.min())) / scale
        whole = replace(part, pressure=pressure, displacement=displacement, residual=max(part.residual, deepest))
        return whole, np.asarray(distance * GAP_WEIGHT < -self.tolerance * scale)


def _padded_span(active: Mask) -> slice:
    """Return the span of the active pixels with a margin; its length is a multiple of 1/_WINDOW_STEPS of the grid."""
    count, where = active.size, np.nonzero(active)[0]
    first, last = max(0, int(where[0]) - _MARGIN), min(count, int(where[-1]) + 1 + _MARGIN)
    step = max(1, -(-count // _WINDOW_STEPS))
    length = min(count, -(-(last - first) // step) * step)
    first = min(first, count - length)
    return slice(first, first + length)


def coarsen(gap: Floats) -> Floats:
    """Return the mean over the finite pixels of each block of _COARSENING pixels; inf if a block has none."""
    rows, cols = (-(-n // _COARSENING) for n in gap.shape)
    padded = np.full((rows * _COARSENING, cols * _COARSENING), np.inf)
    padded[: gap.shape[0], : gap.shape[1]] = gap
    blocks = padded.reshape(rows, _COARSENING, cols, _COARSENING)
    is_finite = np.isfinite(blocks)
    count, total = is_finite.sum(axis=(1, 3)), np.where(is_finite, blocks, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.inf)
