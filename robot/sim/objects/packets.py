"""Execution of formulas on rays and points in packets of `LANES`, by compiled code.

All functions that compiled code calls are in this file (see robot.sim.jit).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot.sim.jit import jit

Floats = NDArray[np.float32]
Vectors = NDArray[np.float64]

LANES = 256
"""Points in a packet."""

MAX_STEPS = 600
"""A ray without a hit after this many steps is a miss."""

OPERATIONS = (
    *("add", "subtract", "multiply", "divide", "maximum", "minimum", "absolute", "sqrt", "rint"),
    *("copysign", "greater", "sin", "cos", "exp", "log", "log1p", "where"),
)
"""Names of the operations; a formula refers to them by index."""

(_ADD, _SUBTRACT, _MULTIPLY, _DIVIDE, _MAXIMUM, _MINIMUM, _ABSOLUTE, _SQRT, _RINT) = range(9)
(_COPYSIGN, _GREATER, _SIN, _COS, _EXP, _LOG, _LOG1P, _WHERE) = range(9, 17)


class Formula(NamedTuple):
    """Operations on rows of `LANES` numbers (made by robot.sim.objects.formula).

    Attributes:
        code: (operations, 5) int64: the operation, the row of its result and of its one to three operands.
        start: (rows,) float32: constants, in their rows; the first rows are the operands.
        results: (n,) int64: the rows of the function's results after the code has run.
    """

    code: NDArray[np.int64]
    start: Floats
    results: NDArray[np.int64]


class ReliefLevel(NamedTuple):
    """One height map (rows, columns) of relief, empty for none.

    It has `per_s` columns per mm along s and `per_t` rows per mm along t. `slope` is an upper bound on its slope.
    """

    height_mm: Floats
    per_s: float
    per_t: float
    max_height_mm: float
    slope: float
    pixel_mm: float

    def at(self, s: Floats, t: Floats) -> Floats:
        """Interpolate heights at map coordinates in mm, (N,) each; clamped at the border."""
        out = np.empty(len(s), np.float32)
        _interpolate_heights(self.height_mm, s * np.float32(self.per_s), t * np.float32(self.per_t), out)
        return out


class DisplacedSolid(NamedTuple):
    """A solid with relief: f = distance(x, y, z) - height(s, t) * mask, in mm; `place` gives (s, t, mask)."""

    distance: Formula
    place: Formula
    relief: ReliefLevel


def evaluate_formula(formula: Formula, *operands: Floats) -> tuple[Floats, ...]:
    """Evaluate the formula on float32 arrays (n,); return its results."""
    values = np.stack(operands)
    results = np.empty((len(formula.results), values.shape[1]), np.float32)
    _evaluate_all(formula.code, _rows(formula), formula.results, values, results)
    return tuple(results)


def _rows(formula: Formula) -> Floats:
    return np.repeat(formula.start[:, None], LANES, axis=1)


@jit
def _evaluate_all(code, rows, places, values, results):  # type: ignore[no-untyped-def]
    for first in range(0, values.shape[1], LANES):
        count = min(LANES, values.shape[1] - first)
        for row in range(values.shape[0]):
            for i in range(count):
                rows[row, i] = values[row, first + i]
        _evaluate(code, rows, count)
        for number in range(len(places)):
            for i in range(count):
                results[number, first + i] = rows[places[number], i]


@jit
def _evaluate(code, r, count):  # type: ignore[no-untyped-def]
    """Execute the code on the first `count` lanes of the rows."""
    for line in range(len(code)):
        name, d, a, b, c = code[line, 0], code[line, 1], code[line, 2], code[line, 3], code[line, 4]
        if name == _ADD:
            for i in range(count):
                r[d, i] = r[a, i] + r[b, i]
        elif name == _SUBTRACT:
            for i in range(count):
                r[d, i] = r[a, i] - r[b, i]
        elif name == _MULTIPLY:
            for i in range(count):
                r[d, i] = r[a, i] * r[b, i]
        elif name == _MAXIMUM:
            for i in range(count):
                r[d, i] = r[a, i] if r[a, i] > r[b, i] else r[b, i]
        elif name == _MINIMUM:
            for i in range(count):
                r[d, i] = r[a, i] if r[a, i] < r[b, i] else r[b, i]
        elif name == _ABSOLUTE:
            for i in range(count):
                r[d, i] = abs(r[a, i])
        elif name == _SQRT:
            for i in range(count):
                r[d, i] = np.sqrt(r[a, i])
        elif name == _DIVIDE:
            for i in range(count):
                r[d, i] = r[a, i] / r[b, i]
        elif name == _WHERE:
            for i in range(count):
                yes, no = r[b, i], r[c, i]
                r[d, i] = yes if r[a, i] != 0 else no
        elif name == _GREATER:
            for i in range(count):
                r[d, i] = np.float32(1) if r[a, i] > r[b, i] else np.float32(0)
        elif name == _RINT:
            for i in range(count):
                r[d, i] = np.rint(r[a, i])
        elif name == _COPYSIGN:
            for i in range(count):
                r[d, i] = np.copysign(r[a, i], r[b, i])
        elif name == _SIN:
            for i in range(count):
                r[d, i] = np.sin(r[a, i])
        elif name == _COS:
            for i in range(count):
                r[d, i] = np.cos(r[a, i])
        elif name == _EXP:
            for i in range(count):
                r[d, i] = np.exp(r[a, i])
        elif name == _LOG:
            for i in range(count):
                r[d, i] = np.log(r[a, i])
        else:
            for i in range(count):
                r[d, i] = np.log1p(r[a, i])


# A solid with relief -----------------------------------------------------------------------------------------


def gradients(solid: DisplacedSolid, points: Vectors, step_mm: float) -> Vectors:
    """Return differences of f, (n, 3), over the corners of a tetrahedron of that size, by four evaluations."""
    out = np.zeros(points.shape)
    _gradients(solid, _rows_of(solid), points, np.float32(step_mm / 2), out)
    return out


class Rays(NamedTuple):
    """Rays (n, 3) and the range along each, (n,) mm, in which a hit is searched; none if near_mm > far_mm."""

    origins: Vectors
    directions: Vectors
    near_mm: Vectors
    far_mm: Vectors


def first_hits(solid: DisplacedSolid, rays: Rays, step_mm: float) -> Vectors:
    """Return the distance (n,) along each ray to the first zero of f; inf if there is none."""
    found, out = _find_crossings(solid, rays, step_mm), np.full(len(rays.near_mm), np.inf)
    _refine(solid, _rows_of(solid), rays.origins, rays.directions, rays.near_mm, found, out)
    return out


def hits(solid: DisplacedSolid, rays: Rays, step_mm: float) -> NDArray[np.bool_]:
    """Return which rays have a first hit, (n,)."""
    return np.asarray(np.isfinite(_find_crossings(solid, rays, step_mm)[0]))


def _find_crossings(solid: DisplacedSolid, rays: Rays, step_mm: float) -> Floats:
    """Return the brackets of the zeros that `_march` finds, (4, n)."""
    found = np.full((4, len(rays.origins)), np.inf, np.float32)
    _march(solid, _rows_of(solid), *rays, np.float32(0.5 * step_mm), found)
    return found


def _rows_of(solid: DisplacedSolid) -> tuple[Floats, Floats]:
    """Return working rows for the two formulas."""
    return _rows(solid.distance), _rows(solid.place)


@jit
def _bilinear(height, u, v):  # type: ignore[no-untyped-def]
    last_row, last_column = height.shape[0] - 1, height.shape[1] - 1
    u = min(max(u, np.float32(0)), np.float32(last_column))
    v = min(max(v, np.float32(0)), np.float32(last_row))
    column, row = np.uint64(u), np.uint64(v)
    right = column + np.uint64(column < last_column)
    below = row + np.uint64(row < last_row)
    p, q = u - np.float32(column), v - np.float32(row)
    upper = height[row, column] + p * (height[row, right] - height[row, column])
    lower = height[below, column] + p * (height[below, right] - height[below, column])
    return upper + q * (lower - upper)


@jit
def _interpolate_heights(height, u, v, out):  # type: ignore[no-untyped-def]
    for i in range(len(u)):
        out[i] = _bilinear(height, u[i], v[i])


@jit
def _relief_heights(solid, rows, count):  # type: ignore[no-untyped-def]
    """Write relief at the points in the rows into the first row."""
    _evaluate(solid.place.code, rows, count)
    s, t, mask = solid.place.results[0], solid.place.results[1], solid.place.results[2]
    per_s, per_t = np.float32(solid.relief.per_s), np.float32(solid.relief.per_t)
    for i in range(count):
        rows[0, i] = _bilinear(solid.relief.height_mm, rows[s, i] * per_s, rows[t, i] * per_t) * rows[mask, i]


@jit
def _evaluate_field(solid, rows, count):  # type: ignore[no-untyped-def]
    """Write f at the points in the first rows of rows[0] into its row of results."""
    base, relief_rows = rows
    if solid.relief.height_mm.size:
        for row in range(3):
            for i in range(count):
                relief_rows[row, i] = base[row, i]
    _evaluate(solid.distance.code, base, count)
    if solid.relief.height_mm.size:
        _relief_heights(solid, relief_rows, count)
        for i in range(count):
            base[solid.distance.results[0], i] -= relief_rows[0, i]


@jit
def _gradients(solid, rows, points, half, out):  # type: ignore[no-untyped-def]
    for first in range(0, len(out), LANES):
        count = min(LANES, len(out) - first)
        for corner in range(4):
            # (1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)
            for axis in range(3):
                side = half if corner == 0 or corner == axis + 1 else -half
                for i in range(count):
                    rows[0][axis, i] = np.float32(points[first + i, axis]) + side
            _evaluate_field(solid, rows, count)
            for axis in range(3):
                sign = 1.0 if corner == 0 or corner == axis + 1 else -1.0
                for i in range(count):
                    out[first + i, axis] += sign * rows[0][solid.distance.results[0], i]


# Rays --------------------------------------------------------------------------------------------------------

_ORIGIN, _DIRECTION, _T, _BEFORE, _F_BEFORE, _ROOM, _STEPS, _LANE_ROWS = 0, 3, 6, 7, 8, 9, 10, 11


@jit
def _march(solid, rows, origins, directions, near, far, finest, found):  # type: ignore[no-untyped-def]
    """Trace spheres until f changes sign; fill `found` with t and f just inside (inf: a miss), t and f just outside.

    Outside the shell that relief can reach, the step is the distance to it. Within, f / L is safe (L bounds the slope
    of f), and the shortest step is a stride: `finest`, or up to four times that for rays that graze for long. When a
    lane's ray ends, the lane takes the next ray, so packets stay full.
    """
    base, relief_rows = rows
    result, has_relief = solid.distance.results[0], solid.relief.height_mm.size > 0
    highest = np.float32(solid.relief.max_height_mm)
    bound = np.float32(1 + solid.relief.slope) if has_relief else np.float32(1)
    lanes = np.zeros((_LANE_ROWS, LANES), np.float32)
    gaps = np.empty(LANES, np.float32)
    ray, low = np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    upcoming, count = 0, 0
    while True:
        while count < LANES and upcoming < len(near):
            if near[upcoming] <= far[upcoming]:
                ray[count] = upcoming
                lanes[_ROOM, count] = np.float32(far[upcoming] - near[upcoming])
                for axis in range(3):
                    start = origins[upcoming, axis] + near[upcoming] * directions[upcoming, axis]
                    lanes[_ORIGIN + axis, count] = np.float32(start)
                    lanes[_DIRECTION + axis, count] = np.float32(directions[upcoming, axis])
                lanes[_T, count] = lanes[_BEFORE, count] = lanes[_F_BEFORE, count] = lanes[_STEPS, count] = 0
                count += 1
            upcoming += 1
        if count == 0:
            break
        for axis in range(3):
            for i in range(count):
                base[axis, i] = lanes[_ORIGIN + axis, i] + lanes[_T, i] * lanes[_DIRECTION + axis, i]
        touched = 0
        if has_relief:
            for axis in range(3):
                for i in range(count):
                    relief_rows[axis, i] = base[axis, i]
        _evaluate(solid.distance.code, base, count)
        for i in range(count):
            gaps[i] = base[result, i] - highest
        if has_relief:
            for i in range(count):
                if gaps[i] <= 0:
                    low[touched] = i
                    for axis in range(3):
                        relief_rows[axis, touched] = relief_rows[axis, i]
                    touched += 1
            if touched:
                _relief_heights(solid, relief_rows, touched)
        for i in range(count):
            base[0, i] = gaps[i]
        for k in range(touched):
            base[0, low[k]] = gaps[low[k]] + highest - relief_rows[0, k]
        for i in range(count):
            if base[0, i] <= 0:
                found[0, ray[i]], found[1, ray[i]] = lanes[_T, i], base[0, i]
                found[2, ray[i]], found[3, ray[i]] = lanes[_BEFORE, i], lanes[_F_BEFORE, i]
        for i in range(count):
            f, gap, t, outside = base[0, i], gaps[i], lanes[_T, i], gaps[i] > 0
            stride = finest * min(max(lanes[_STEPS, i] / np.float32(40), np.float32(1)), np.float32(4))
            forward = f / bound if f / bound > gap else gap
            forward += stride if outside else np.float32(0)
            # f is unknown outside the shell: 0 requests its computation later.
            lanes[_F_BEFORE, i] = np.float32(0) if outside else f
            lanes[_BEFORE, i] = t + gap if outside else t
            lanes[_T, i] = t + (forward if forward > stride else stride)
            lanes[_STEPS, i] += np.float32(1)
        end = count
        count = 0
        for i in range(end):
            if base[0, i] > 0 and lanes[_BEFORE, i] <= lanes[_ROOM, i] and lanes[_STEPS, i] < MAX_STEPS:
                if count < i:
                    ray[count] = ray[i]
                    for row in range(_LANE_ROWS):
                        lanes[row, count] = lanes[row, i]
                count += 1


@jit
def _refine(solid, rows, origins, directions, near, found, out):  # type: ignore[no-untyped-def]
    """Narrow the bracket of the zero by false position: two refinements and a final interpolation."""
    base, result = rows[0], solid.distance.results[0]
    ray = np.empty(LANES, np.int64)
    upcoming = 0
    while upcoming < len(near):
        count = 0
        while count < LANES and upcoming < len(near):
            if np.isfinite(found[0, upcoming]):
                ray[count] = upcoming
                count += 1
            upcoming += 1
        for turn in range(3):
            for i in range(count):
                number = ray[i]
                t = _zero_crossing(found, number) if turn else found[2, number]
                for axis in range(3):
                    start = origins[number, axis] + near[number] * directions[number, axis]
                    base[axis, i] = np.float32(start) + t * np.float32(directions[number, axis])
            _evaluate_field(solid, rows, count)
            for i in range(count):
                number, f = ray[i], base[result, i]
                if turn == 0:
                    if found[3, number] == 0:
                        found[3, number] = f
                elif f > 0:
                    found[2, number], found[3, number] = _zero_crossing(found, number), f
                else:
                    found[0, number], found[1, number] = _zero_crossing(found, number), f
        for i in range(count):
            out[ray[i]] = near[ray[i]] + _zero_crossing(found, ray[i])


@jit
def _zero_crossing(found, number):  # type: ignore[no-untyped-def]
    """Return where the chord from f > 0 before to f <= 0 at the hit meets 0."""
    high, f_high, low, f_low = found[0, number], found[1, number], found[2, number], found[3, number]
    fraction = f_low / max(f_low - f_high, np.float32(1e-9))
    return low + min(max(fraction, np.float32(0)), np.float32(1)) * (high - low)
