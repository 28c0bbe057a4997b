"""What makes the simulated rig fast: steps of its rays, grid of the sky's light, float32 in the gel's contact."""

import math
from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from retrieval.lab.frontier.clock import timed
from retrieval.lab.frontier.contact import LAYER
from retrieval.lab.frontier.points import Panel, Row, Tradeoff, smallest
from retrieval.lab.frontier.sample import Sample
from robot.sim.camera import SKY_STEPS, PinholeCamera, Placement, hidden_sky, look
from robot.sim.contact.layer import SINGLE_FROM
from robot.sim.contact.scaled_problem import ElasticSurface, Task
from robot.sim.objects.body import GEL_STEP_MM, SdfBody
from robot.sim.objects.draw import draw_object
from robot.sim.pinch import Hand

Array = NDArray[np.float64]
_FAMILIES = ("knurl", "bumps", "weave")
_SKY_SHARE = 0.45 * 0.25 / 0.5
"""How much of a table's light is the sky's that an object can hide, about."""

# Rays ------------------------------------------------------------------------------------------------------


def rays(sample: Sample) -> Row:
    """The finest step of a gel's rays."""
    text = (
        "Rays from a gel's pixels to a wall that wears relief: no step is shorter than half the detail that is asked "
        "for, and where f changes sign two secants find the place. Against equal steps of 0.01 mm in plain numpy. A "
        "gel's picture shows heights of some thousandths of a mm."
    )
    panel = rays_panel(sample.scale.repeats, rows=12) if sample.scale.quick else rays_panel(sample.scale.repeats)
    return Row("Rays of the simulated rig: step", text, (panel,))


def rays_panel(repeats: int, rows: int = 48, steps_mm: Sequence[float] = (1.6, 0.8, 0.4, 0.2, 0.1, 0.05)) -> Panel:
    """A point for each step: the rms error of depth over the walls of three objects, `rows` by 4/3 `rows` rays each."""
    walls = [(body, *_rays_onto(body, rows)) for body in map(_wall, _FAMILIES)]
    exact = np.concatenate([_by_equal_steps(*wall) for wall in walls])
    met = np.isfinite(exact)
    points, works = list[Tradeoff](), [partial(_cast, walls, step) for step in steps_mm]
    for step, work in zip(steps_mm, works, strict=True):
        found = work()
        both = met & np.isfinite(found)
        error = 1e3 * math.sqrt(float(np.mean((found[both] - exact[both]) ** 2)))
        points.append(Tradeoff("", f"{step:g} mm", error, is_default=step == GEL_STEP_MM))
    made = timed(points, works, repeats)
    reference, time = "equal steps of 0.01 mm", f"{len(exact):,} rays"
    return Panel("step of a gel's rays", time, "um rms of depth", reference, 2.0, made, smallest(made))


def _wall(relief: str) -> SdfBody:
    body = draw_object(0, 0, family="box", relief=relief).body
    assert isinstance(body, SdfBody)
    return body


def _rays_onto(body: SdfBody, rows: int) -> tuple[Array, Array]:
    """Parallel rays from the front, 6 mm apart from the box, over 12 x 16 mm of its middle."""
    height, width = 12.0, 16.0
    z = 0.5 * body.upper[2] + height * (np.arange(rows) / rows - 0.5)
    x, up = np.meshgrid(width * (np.arange(rows * 4 // 3) / (rows * 4 // 3) - 0.5), z)
    origins = np.stack([x, np.full_like(x, body.lower[1] - 6.0), up], axis=-1).reshape(-1, 3)
    return origins, np.broadcast_to([0.0, 1.0, 0.0], origins.shape)


def _cast(walls: Sequence[tuple[SdfBody, Array, Array]], step_mm: float) -> Array:
    return np.concatenate([body.cast(origins, directions, step_mm) for body, origins, directions in walls])


def _by_equal_steps(body: SdfBody, origins: Array, directions: Array, step_mm: float = 0.01) -> Array:
    """Where the field in plain numpy first changes sign, and there by its chord."""
    found, before = np.full(len(origins), np.inf), np.full(len(origins), np.inf)
    for t in np.arange(5.0, 14.0, step_mm):
        open_ = np.flatnonzero(np.isinf(found))
        if not len(open_):
            break
        f = body.field(*(origins[open_] + t * directions[open_]).astype(np.float32).T).astype(np.float64)
        inside = f <= 0
        hit = open_[inside]
        found[hit] = t + step_mm * f[inside] / (before[hit] - f[inside]) if t > 5.0 else t
        before[open_] = f
    return found


# Sky -------------------------------------------------------------------------------------------------------


def sky(sample: Sample) -> Row:
    """The grid on which the sky is blurred that an object hides from the table."""
    text = (
        "Beside an object the table sees less of the sky: the object's mask, blurred, on a coarse grid of so many "
        "points over the blur's width, in a photo of 512 px. The error is the largest of the table's light."
    )
    return Row("Sky that an object hides: grid", text, (sky_panel(sample.scale.repeats),))


def sky_panel(repeats: int, px: int = 512, steps: Sequence[int] = (1, 2, 4, 8)) -> Panel:
    """A point for each number of steps: the largest error of the table's light in per cent."""
    view = look(draw_object(0, 3), Placement(), PinholeCamera(px=px, focal_px=860 * px / 256))
    mask = view.is_object.reshape(px, px)
    exact = cv2.GaussianBlur(mask.astype(np.float64), (0, 0), 0.03 * px)
    points, works = list[Tradeoff](), [partial(hidden_sky, mask, count) for count in steps]
    for count, work in zip(steps, works, strict=True):
        error = 100.0 * _SKY_SHARE * float(np.abs(work() - exact)[~mask].max())
        points.append(Tradeoff("", f"{count} steps", error, is_default=count == SKY_STEPS))
    made = timed(points, works, repeats)
    return Panel(
        "sky that an object hides", f"a photo of {px} px", "% of light", "the full grid", 1.0, made, smallest(made)
    )


# Contact ---------------------------------------------------------------------------------------------------


def contact_products(sample: Sample) -> Row:
    """float32 in the products of the gel's contact."""
    text = (
        "A ball with ridges pressed into a layer on the rig's grid: the products of pressure and influence by FFT in "
        "float32 or in float64, and the solver's tolerance. The rig's contacts, at a tolerance of "
        f"{SINGLE_FROM:g} or more, take float32."
    )
    repeats = sample.scale.repeats
    panel = products_panel(repeats, rows=48) if sample.scale.quick else products_panel(repeats)
    return Row("Contact of the gel: float32", text, (panel,))


def products_panel(repeats: int, rows: int | None = None, tolerances: Sequence[float] = (1e-1, 1e-2, 1e-3)) -> Panel:
    """A point for each precision and tolerance: rms error of the surface against float64 at 1e-8 on the same grid."""
    hand = Hand()
    grid = hand.grid if rows is None else (rows, rows * 4 // 3)
    pixel_mm = 15.2 / grid[0]
    y, x = (pixel_mm * (np.arange(n) - (n - 1) / 2) for n in grid)
    gap = (y[:, None] ** 2 + x**2) / 30.0 + 0.1 * (1.0 - np.cos(2.0 * math.pi * x / 1.5))
    exact = _pressed(gap, pixel_mm, 1e-8, False)
    points, works = list[Tradeoff](), []
    for single in (False, True):
        for tolerance in tolerances:
            works.append(partial(_pressed, gap, pixel_mm, tolerance, single))
            error = 1e3 * math.sqrt(float(np.mean((works[-1]() - exact) ** 2)))
            is_default = (tolerance, single) == (hand.tolerance, True)
            series = "float32" if single else "float64"
            points.append(Tradeoff(series, f"tolerance {tolerance:g}", error, is_default=is_default))
    made = timed(points, works, repeats)
    reference = "float64, tolerance 1e-08"
    return Panel("precision of contact", "one contact", "um rms of surface", reference, 0.1, made, smallest(made))


def _pressed(gap: Array, pixel_mm: float, tolerance: float, single: bool, force_n: float = 3.0) -> Array:
    """(rows, cols) mm of displacement by so much force."""
    scale = force_n / LAYER.plane_modulus_mpa / pixel_mm**2
    surface = ElasticSurface(LAYER.thickness_mm / pixel_mm, LAYER.poisson, 0.0, False, single)
    solution = Task(surface, gap / pixel_mm / scale, 1.0, 1.0, tolerance, 1000).solve()
    return np.asarray(solution.displacement * scale * pixel_mm)
