"""Degree of the fitted gel optics: error on real presses against the time of a picture."""

import math
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.optics.photometric import DEGREES, by_degree
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff
from retrieval.frontier.sample import Sample
from robot.sim.gel.fitted_optics import FittedOptics, fitted_document, load_fitted
from robot.sim.gel.surface import Field, Surface


def gel_optics(sample: Sample) -> ApproximationResult:
    """Measure the degree of the fitted gel optics on real presses."""
    text = "Pictures of real balls pressed into a real gel, left out of the fit, compared with the model's predictions."
    return ApproximationResult("Gel optics: degree of the fitted model", text, (optics_panel(sample.scale.repeats),))


def optics_panel(repeats: int, name: str = "gelsight") -> Panel:
    """Return a point per degree of the fitted optics: a picture of 240 x 320 pixels, its maps computed before.

    The error is the rms over held-out real presses, in grey levels, from the shipped file.
    """
    shipped, figures = load_fitted(name), fitted_document(name)["held_out"]
    x, y = Field().unit_positions()
    surface = Surface(np.maximum(0, 0.5 - x * x - y * y), Field())
    points = [
        Tradeoff(
            series=name,
            setting=f"degree {degree}",
            error=math.sqrt(figures[by_degree(degree)]["mse"]["mean"]),
            is_default=degree == shipped.degree,
        )
        for degree in DEGREES
    ]
    works = [partial(_of_degree(shipped, degree).colours, surface, surface.slopes) for degree in DEGREES]
    timed = time_points(points, works, repeats)
    return Panel(
        title="gel optics",
        time="one picture of 240 x 320 pixels",
        unit="grey levels rms",
        reference="real presses held out",
        tolerance=3.5,
        points=timed,
    )


def _of_degree(optics: FittedOptics, degree: int) -> FittedOptics:
    """Return optics with the cost of this degree; the time does not depend on the values of the weights."""
    count = (degree * (degree + 3) // 2 + 3 * len(optics.reaches_mm)) * optics.places
    return replace(optics, degree=degree, weights=((0.0, 0.0, 0.0),) * count)
