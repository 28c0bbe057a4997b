"""Error against run time of the simulation's approximations, as data: what is left out and what that costs."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from retrieval.lab.contact.closed_forms import BALL_MM, HALF_SPACE, Grid, hertz, percent, pressed_ball
from retrieval.lab.contact.closed_forms import closed_form_table as closed_form_table
from retrieval.lab.contact.closing_jaws import Jaws, LinearLaw, Motion, close
from retrieval.lab.hard_cases.contact import stability_sweep as stability_sweep
from robot.sim.contact.kernels import Floats
from robot.sim.contact.layer import Contact, Layer, press
from robot.sim.gel.optics import LedOptics
from robot.sim.gel.surface import Field, Surface
from robot.sim.pinch import Hand

LAYER = Layer(HALF_SPACE.modulus_mpa, 0.48, 2.0)
T = TypeVar("T")


@dataclass(frozen=True)
class Point:
    """One setting of one approximation: what it costs in `seconds`, and its `error` in `unit` against `reference`.

    is_default: whether the simulated rig uses it unless told otherwise.
    """

    approximation: str
    setting: str
    seconds: float
    error: float
    unit: str
    reference: str
    is_default: bool = False


def timed(work: Callable[[], T], repeats: int = 5) -> tuple[float, T]:
    """The shortest of `repeats` runs in s, after one that fills the caches, and what the work gave."""
    result, best = work(), math.inf
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best, result


# Contact ---------------------------------------------------------------------------------------------------


def contact_points(
    *,
    rows: tuple[int, ...] = (30, 60, 120, 240),
    tolerances: tuple[float, ...] = (1e-1, 1e-2, 1e-3, 1e-4),
    reference_rows: int = 480,
) -> tuple[Point, ...]:
    """Grid, tolerance and padding of the contact solver, for a ball of 4 mm.

    On the half-space against Hertz; on a layer of 2 mm against `reference_rows` at a tolerance of 1e-6, of which each
    number of rows must be an even part; then the gel image of a ridged ball against the same grid's. About half a
    minute.
    """
    return (
        *_hertz_points(rows, tolerances),
        *_layer_points(rows, tolerances, reference_rows),
        *_picture_points(rows, tolerances, reference_rows),
    )


def _hertz_points(rows: tuple[int, ...], tolerances: tuple[float, ...], force_n: float = 0.5) -> Iterator[Point]:
    depth = hertz(force_n, BALL_MM, HALF_SPACE.plane_modulus_mpa)[1]
    for grid in map(Grid.of_field, rows):
        for tolerance in tolerances:
            seconds, contact = timed(partial(pressed_ball, grid, HALF_SPACE, force_n, tolerance))
            error = percent(contact.approach_mm, depth)
            setting = f"{grid}, tolerance {tolerance:g}"
            yield Point(
                "contact grid and tolerance, half-space",
                setting,
                seconds,
                error,
                "% of depth",
                "Hertz",
                _is_default(grid, tolerance),
            )


def _layer_points(rows: tuple[int, ...], tolerances: tuple[float, ...], reference_rows: int) -> Iterator[Point]:
    fine = pressed_ball(Grid.of_field(reference_rows), LAYER, 1.0, 1e-6)
    reference = f"{Grid.of_field(reference_rows)}, tolerance 1e-06"
    for grid in map(Grid.of_field, rows):
        exact = _at_centres(fine.displacement_mm, reference_rows // grid.rows)
        for padded in (False, True):
            for tolerance in tolerances:
                seconds, contact = timed(partial(pressed_ball, grid, LAYER, 1.0, tolerance, padded))
                error = 1e3 * math.sqrt(float(np.mean((contact.displacement_mm - exact) ** 2)))
                setting = f"{grid}, tolerance {tolerance:g}, {'padded' if padded else 'periodic'}"
                yield Point(
                    "contact grid and tolerance, layer",
                    setting,
                    seconds,
                    error,
                    "um rms of surface",
                    reference,
                    padded and _is_default(grid, tolerance),
                )


def _picture_points(rows: tuple[int, ...], tolerances: tuple[float, ...], reference_rows: int) -> Iterator[Point]:
    """What the camera sees of ridges: the error that matters to who looks at gel images."""
    exact = _picture(_pressed_ridges(_of_gel(reference_rows), 1e-6))
    reference = f"{_of_gel(reference_rows)}, tolerance 1e-06"
    for grid in map(_of_gel, rows):
        for tolerance in tolerances:
            seconds, contact = timed(partial(_pressed_ridges, grid, tolerance))
            error = math.sqrt(float(np.mean((_picture(contact) - exact) ** 2)))
            setting = f"{grid}, tolerance {tolerance:g}"
            is_default = _is_default(grid, tolerance)
            yield Point(
                "contact grid and tolerance, gel image of ridges",
                setting,
                seconds,
                error,
                "grey levels rms",
                reference,
                is_default,
            )


def _pressed_ridges(grid: Grid, tolerance: float) -> Contact:
    """A ball of 15 mm with ridges 1.5 mm apart, the finest that objects are drawn with, and .2 mm high, at 3 N."""
    ridges = 0.1 * (1.0 - np.cos(2.0 * math.pi * grid.axes()[1] / 1.5))
    gap = grid.radius() ** 2 / 30.0 + ridges
    return press(gap, grid.pixel_mm, LAYER, force_n=3.0, tolerance=tolerance)


def _of_gel(rows: int) -> Grid:
    """`rows` rows over what the gel's camera sees."""
    return Grid(rows, rows * 4 // 3, Field().size_mm[0] / rows)


def _picture(contact: Contact) -> Floats:
    """(240, 320, 3) grey levels of the gel by its lamps, before noise and rounding."""
    surface = Surface(contact.displacement_mm, Field())
    return LedOptics().colours(surface, surface.slopes).astype(np.float64)


def _is_default(grid: Grid, tolerance: float) -> bool:
    """Whether the gripper's contacts are solved so."""
    hand = Hand()
    return ((grid.rows, grid.cols), tolerance) == (hand.grid, hand.tolerance)


def _at_centres(fine: Floats, factor: int) -> Floats:
    """A fine field at the centres of blocks of `factor` pixels: the mean of the four pixels that meet there."""
    rows, cols = (n // factor for n in fine.shape)
    blocks = fine.reshape(rows, factor, cols, factor)
    middle = slice(factor // 2 - 1, factor // 2 + 1)
    return np.asarray(blocks[:, middle, :, middle].mean(axis=(1, 3)))


# Closing ---------------------------------------------------------------------------------------------------


def closing_points(*, steps_s: tuple[float, ...] = (2e-3, 1e-3, 5e-4, 2e-4, 1e-4)) -> tuple[Point, ...]:
    """Step of the closing jaws: force over 50 ms against the oscillator's closed form, 1e5 N/m and 20 N."""
    stiffness, force = 100.0, 20.0
    motion = Motion(Jaws(force), (LinearLaw(stiffness), LinearLaw(stiffness)))
    points = []
    for step in steps_s:
        seconds, (times, states) = timed(partial(close, motion, 0.05, step), 1)
        travel = spring_closing(motion.jaws, stiffness, times)
        error = 100.0 * stiffness / force * float(np.abs(states[:, 0] - travel).max())
        points.append(Point("closing step", f"{step:g} s", seconds, error, "% of force", "closed form of a spring"))
    return tuple(points)


def spring_closing(jaws: Jaws, stiffness_n_mm: float, times_s: Floats) -> Floats:
    """Travel in mm of a jaw that starts at rest on a spring: m s'' + c s' + k s = F, underdamped."""
    mass = jaws.jaw_mass_kg / 1e3
    decay = jaws.jaw_damping_n_s_mm / (2.0 * mass)
    turn = math.sqrt(stiffness_n_mm / mass - decay**2)
    swing = np.exp(-decay * times_s) * (np.cos(turn * times_s) + decay / turn * np.sin(turn * times_s))
    return np.asarray(jaws.force_n / stiffness_n_mm * (1.0 - swing))
