"""The contact problem in scaled units (pixel 1, E* of the gel 1): coarse grid first, then a window around the contact.

Influences do not wrap around, so a window of the grid is exact as long as nothing outside it is touched. The whole
field is looked at once at the end, and the window grows if the object touches beside it.
"""

import functools
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from robot.sim.contact.constrained_cg import GAP_WEIGHT, ContactProblem, Solution
from robot.sim.contact.kernels import Floats, Operator, Quadrant, influence, layer_compliance, periodic_influence

_COARSER = 4
_NEST_FROM = 48  # pixels along the shorter side below which a coarser grid saves nothing
_MARGIN = 2  # pixels around the coarse grid's contact
_COARSE_CAP = 40  # iterations on the coarse grid, which only gives a start
_STEPS = 8  # a window's sides are multiples of an eighth of the grid's: few operators to keep

Mask = npt.NDArray[np.bool_]
Window = tuple[slice, slice]


@dataclass(frozen=True)
class ElasticSurface:
    """A layer `thickness` pixels thick; `softness` is its E* over the object's, 0 for a rigid object; `single`: by
    products in float32."""

    thickness: float
    poisson: float
    softness: float
    periodic: bool
    single: bool = False

    def gel(self, grid: Quadrant, window: Quadrant) -> Operator:
        """Displacement of the gel by a pressure on a window of the grid."""
        return _operator(grid, window, self.thickness, self.poisson, self.periodic, self.single)

    def both(self, grid: Quadrant, window: Quadrant) -> Operator:
        """Displacement of the gel and of the object, a half-space, together."""
        gel = self.gel(grid, window)
        if self.softness == 0.0:
            return gel
        half_space = _operator(grid, window, math.inf, self.poisson, self.periodic, self.single)
        return gel.plus(half_space, self.softness)

    def loses_volume(self) -> bool:
        """Whether the mean displacement can differ from 0."""
        return not self.periodic or float(layer_compliance(np.zeros(1), self.thickness, self.poisson)[0]) > 0.0


@functools.lru_cache(maxsize=128)
def _operator(
    grid: Quadrant, window: Quadrant, thickness: float, poisson: float, periodic: bool, single: bool
) -> Operator:
    table = periodic_influence(grid, thickness, poisson) if periodic else influence(grid, thickness, poisson)
    return Operator(table, window, periodic=periodic, single=single)


@dataclass(frozen=True)
class Task:
    """Press with `load` (sum of pressures), or where it is None to `depth`; `gap` (rows, cols) is inf where empty."""

    surface: ElasticSurface
    gap: Floats
    load: float | None
    depth: float
    tolerance: float
    max_iterations: int

    def solve(self) -> Solution:
        """From the coarse grid's pressure where that helps."""
        start = self._coarse_start() if min(self.gap.shape) >= _NEST_FROM else None
        if start is None:
            start = self._problem(_whole(self.gap.shape)).guess()
        return self._refine(start)

    def _problem(self, window: Window) -> ContactProblem:
        gap = np.ascontiguousarray(self.gap[window])
        return ContactProblem(self.surface.both(self.gap.shape, gap.shape), gap, self.load, self.depth)

    def _coarse_start(self) -> Floats | None:
        """The coarse grid's pressure on the fine one; None if the coarse grid does not touch."""
        gap = coarser(self.gap) / _COARSER
        load = None if self.load is None else self.load / _COARSER**2
        surface = replace(self.surface, thickness=self.surface.thickness / _COARSER)
        coarse = replace(
            self, surface=surface, gap=gap, load=load, depth=self.depth / _COARSER, max_iterations=_COARSE_CAP
        )
        if load is None and gap.min() >= coarse.depth:
            return None
        rows, cols = (n * _COARSER for n in gap.shape)
        pressure = cv2.resize(coarse.solve().pressure, (cols, rows), interpolation=cv2.INTER_LINEAR)
        pressure = np.where(np.isfinite(self.gap), pressure[: self.gap.shape[0], : self.gap.shape[1]], 0.0)
        total = float(pressure.sum())
        return pressure if self.load is None or total <= 0.0 else pressure * (self.load / total)

    def _refine(self, start: Floats) -> Solution:
        """Solve on a window around `start`, larger each time until nothing outside it is touched."""
        wanted, iterations = start > 0.0, 0
        while True:
            window = _whole(self.gap.shape)
            if not self.surface.periodic:  # around the wanted pixels
                window = _span(np.asarray(wanted.any(axis=1))), _span(np.asarray(wanted.any(axis=0)))
            part = self._problem(window).solve(start[window], self.tolerance, self.max_iterations - iterations)
            iterations += part.iterations
            solution, missed = self._looked_at(part, window)
            if not part.converged or not missed.any():
                return replace(solution, iterations=iterations)
            wanted, start = (solution.pressure > 0.0) | missed, solution.pressure

    def _looked_at(self, part: Solution, window: Window) -> tuple[Solution, Mask]:
        """The window's solution on the whole field, and where the object touches outside the window."""
        pressure, missed = np.zeros(self.gap.shape), np.zeros(self.gap.shape, bool)
        pressure[window] = part.pressure
        if part.pressure.size == pressure.size:
            return part, missed
        displacement = self._problem(_whole(self.gap.shape)).operator(pressure)
        distance = displacement + self.gap - part.approach
        distance[window] = 0.0
        scale = float(np.abs(displacement).max()) or 1.0
        deepest = GAP_WEIGHT * max(0.0, -float(distance.min())) / scale
        whole = replace(part, pressure=pressure, displacement=displacement, residual=max(part.residual, deepest))
        return whole, np.asarray(distance * GAP_WEIGHT < -self.tolerance * scale)


def _whole(shape: tuple[int, ...]) -> Window:
    return slice(0, shape[0]), slice(0, shape[1])


def _span(wanted: Mask) -> slice:
    """Where any is wanted, with a margin, in one of _STEPS lengths."""
    count, where = wanted.size, np.nonzero(wanted)[0]
    first, last = max(0, int(where[0]) - _MARGIN), min(count, int(where[-1]) + 1 + _MARGIN)
    step = max(1, -(-count // _STEPS))
    length = min(count, -(-(last - first) // step) * step)
    first = min(first, count - length)
    return slice(first, first + length)


def coarser(gap: Floats) -> Floats:
    """Mean over blocks of _COARSER pixels of what is there; inf where a block is empty."""
    rows, cols = (-(-n // _COARSER) for n in gap.shape)
    padded = np.full((rows * _COARSER, cols * _COARSER), np.inf)
    padded[: gap.shape[0], : gap.shape[1]] = gap
    blocks = padded.reshape(rows, _COARSER, cols, _COARSER)
    there = np.isfinite(blocks)
    count, total = there.sum(axis=(1, 3)), np.where(there, blocks, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.inf)
