"""Approximations of the simulated rig's gel contact: grid, tolerance and precision."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from benchmarks.frontier.closed_forms import BALL_MM, HALF_SPACE, Grid, hertz, percent, pressed_ball
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff
from retrieval.frontier.sample import Sample
from robot.sim.contact.kernels import Floats
from robot.sim.contact.layer import SINGLE_PRECISION_TOLERANCE, Contact, Layer, press
from robot.sim.contact.scaled_problem import ElasticSurface, ScaledProblem
from robot.sim.gel.optics import LedOptics
from robot.sim.gel.surface import Field, Surface
from robot.sim.scene import Hand

LAYER = Layer(HALF_SPACE.modulus_mpa, 0.48, 2.0)
CAMERA_NOISE = 0.8
"""Read noise of a sensor in grey levels; effects visible to the model are larger."""

# Contact ---------------------------------------------------------------------------------------------------


def contact(sample: Sample) -> ApproximationResult:
    """Measure grid and tolerance of the gel's contact. Under a minute."""
    text = (
        "A ball pressed into the gel: on a half-space, compared with Hertz's closed form; on a layer, as on the "
        "simulated fingers, compared with a fine grid. Then the camera's image of a ball with ridges 1.5 mm apart, the "
        "finest relief of simulated objects. This image decides the grid, because an error below the camera's noise is "
        "not visible. Each colour is a grid, each point a tolerance of the solver."
    )
    repeats = sample.scale.repeats
    panels = contact_panels(repeats, (30, 120), (1e-1, 1e-2), 240) if sample.scale.quick else contact_panels(repeats)
    return ApproximationResult("Contact of the gel: grid and tolerance", text, panels)


def contact_panels(
    repeats: int,
    rows: Sequence[int] = (30, 60, 120, 240),
    tolerances: Sequence[float] = (1e-1, 1e-2, 1e-3, 1e-4),
    reference_rows: int = 480,
) -> tuple[Panel, Panel, Panel]:
    """Return the panels for grid and tolerance of the contact solver.

    A ball of 4 mm on the half-space is compared with Hertz; on a layer of 2 mm with `reference_rows` at a tolerance of
    1e-6, a multiple by an even factor of each number of rows. Then the gel image of a ridged ball is compared with that
    of the reference grid.
    """
    return (
        _half_space(repeats, rows, tolerances),
        _layer(repeats, rows, tolerances, reference_rows),
        _gel_image(repeats, rows, tolerances, reference_rows),
    )


def _half_space(repeats: int, rows: Sequence[int], tolerances: Sequence[float], force_n: float = 0.5) -> Panel:
    depth = hertz(force_n, BALL_MM, HALF_SPACE.plane_modulus_mpa)[1]
    points, works = list[Tradeoff](), list[Callable[[], Contact]]()
    for grid in map(Grid.of_field, rows):
        for tolerance in tolerances:
            works.append(partial(pressed_ball, grid, HALF_SPACE, force_n, tolerance))
            points.append(_point(grid, tolerance, percent(works[-1]().approach_mm, depth)))
    return _panel("half-space", "% of depth", "Hertz", 0.1, points, works, repeats)


def _layer(repeats: int, rows: Sequence[int], tolerances: Sequence[float], reference_rows: int) -> Panel:
    fine = pressed_ball(Grid.of_field(reference_rows), LAYER, 1.0, 1e-6)
    points, works = list[Tradeoff](), list[Callable[[], Contact]]()
    for grid in map(Grid.of_field, rows):
        exact = _at_centres(fine.displacement_mm, reference_rows // grid.rows)
        for tolerance in tolerances:
            works.append(partial(pressed_ball, grid, LAYER, 1.0, tolerance))
            error = 1e3 * math.sqrt(float(np.mean((works[-1]().displacement_mm - exact) ** 2)))
            points.append(_point(grid, tolerance, error))
    reference = f"{Grid.of_field(reference_rows)}, tolerance 1e-06"
    return _panel("layer", "um rms of surface", reference, 0.1, points, works, repeats)


def _gel_image(repeats: int, rows: Sequence[int], tolerances: Sequence[float], reference_rows: int) -> Panel:
    """Return the panel for the camera's image of ridges: the error that matters for gel images."""
    exact = _picture(_pressed_ridges(_of_gel(reference_rows), 1e-6))
    points, works = list[Tradeoff](), list[Callable[[], Contact]]()
    for grid in map(_of_gel, rows):
        for tolerance in tolerances:
            works.append(partial(_pressed_ridges, grid, tolerance))
            error = math.sqrt(float(np.mean((_picture(works[-1]()) - exact) ** 2)))
            points.append(_point(grid, tolerance, error))
    reference = f"{_of_gel(reference_rows)}, tolerance 1e-06"
    return _panel("gel image of ridges", "grey levels rms", reference, CAMERA_NOISE, points, works, repeats)


def _point(grid: Grid, tolerance: float, error: float) -> Tradeoff:
    """Return one setting of the solver; the default is that of the gripper's contacts."""
    is_default = ((grid.rows, grid.cols), tolerance) == (Hand.grid, Hand.tolerance)
    return Tradeoff(f"{grid}", f"tolerance {tolerance:g}", abs(error), is_default=is_default)


def _panel(
    surface: str,
    unit: str,
    reference: str,
    tolerance: float,
    points: Sequence[Tradeoff],
    works: Sequence[Callable[[], object]],
    repeats: int,
) -> Panel:
    title = f"contact grid and tolerance, {surface}"
    return Panel(title, "one contact", unit, reference, tolerance, time_points(points, works, repeats))


def _pressed_ridges(grid: Grid, tolerance: float) -> Contact:
    """Press a ball of 15 mm with ridges 1.5 mm apart, the finest of simulated objects, and .2 mm high, at 3 N."""
    ridges = 0.1 * (1.0 - np.cos(2.0 * math.pi * grid.axes()[1] / 1.5))
    gap = grid.radius() ** 2 / 30.0 + ridges
    return press(gap, grid.pixel_mm, LAYER, force_n=3.0, tolerance=tolerance)


def _of_gel(rows: int) -> Grid:
    """Return `rows` rows over the field of the gel's camera."""
    return Grid(rows, rows * 4 // 3, Field().size_mm[0] / rows)


def _picture(contact: Contact) -> Floats:
    """Return grey levels (240, 320, 3) of the gel under its lamps, before noise and rounding."""
    surface = Surface(contact.displacement_mm, Field())
    return LedOptics().colours(surface, surface.slopes).astype(np.float64)


def _at_centres(fine: Floats, factor: int) -> Floats:
    """Sample a fine field at the centres of blocks of `factor` pixels: the mean of the four pixels around them."""
    rows, cols = (n // factor for n in fine.shape)
    blocks = fine.reshape(rows, factor, cols, factor)
    middle = slice(factor // 2 - 1, factor // 2 + 1)
    return np.asarray(blocks[:, middle, :, middle].mean(axis=(1, 3)))


# Products ---------------------------------------------------------------------------------------------------


def contact_products(sample: Sample) -> ApproximationResult:
    """Measure float32 in the products of the gel's contact."""
    text = (
        "A ball with ridges pressed into a layer on the rig's grid: the products of pressure and influence by FFT in "
        "float32 or in float64, and the solver's tolerance. The rig's contacts use float32 at a tolerance of "
        f"{SINGLE_PRECISION_TOLERANCE:g} or more."
    )
    repeats = sample.scale.repeats
    panel = products_panel(repeats, rows=48) if sample.scale.quick else products_panel(repeats)
    return ApproximationResult("Contact of the gel: float32", text, (panel,))


def products_panel(repeats: int, rows: int | None = None, tolerances: Sequence[float] = (1e-1, 1e-2, 1e-3)) -> Panel:
    """Return a point for each precision and tolerance: rms error of the surface against float64 at 1e-8, same grid."""
    hand = Hand()
    grid = hand.grid if rows is None else (rows, rows * 4 // 3)
    pixel_mm = 15.2 / grid[0]
    y, x = (pixel_mm * (np.arange(n) - (n - 1) / 2) for n in grid)
    gap = (y[:, None] ** 2 + x**2) / 30.0 + 0.1 * (1.0 - np.cos(2.0 * math.pi * x / 1.5))
    exact = _pressed(gap, pixel_mm, 1e-8, False)
    points, works = list[Tradeoff](), []
    for single_precision in (False, True):
        for tolerance in tolerances:
            works.append(partial(_pressed, gap, pixel_mm, tolerance, single_precision))
            error = 1e3 * math.sqrt(float(np.mean((works[-1]() - exact) ** 2)))
            is_default = (tolerance, single_precision) == (hand.tolerance, True)
            series = "float32" if single_precision else "float64"
            points.append(Tradeoff(series, f"tolerance {tolerance:g}", error, is_default=is_default))
    labels = "precision of contact", "one contact", "um rms of surface", "float64, tolerance 1e-08"
    return Panel(*labels, 0.1, time_points(points, works, repeats))


def _pressed(gap: Floats, pixel_mm: float, tolerance: float, single_precision: bool, force_n: float = 3.0) -> Floats:
    """Return the displacement (rows, cols) in mm under this force."""
    scale = force_n / LAYER.plane_modulus_mpa / pixel_mm**2
    surface = ElasticSurface(LAYER.thickness_mm / pixel_mm, LAYER.poisson, 0.0, single_precision)
    solution = ScaledProblem(surface, gap / pixel_mm / scale, 1.0, 1.0, tolerance, 1000).solve()
    return np.asarray(solution.displacement * scale * pixel_mm)
