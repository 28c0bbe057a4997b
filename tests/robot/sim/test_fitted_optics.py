"""Optics fitted to real presses: the polynomial, its limits, and its file."""

import json
import math

import numpy as np
import pytest

from robot.sim.gel import fitted_optics
from robot.sim.gel.fitted_optics import FITTED, FittedLimits, FittedOptics, load_fitted
from robot.sim.gel.surface import Field, Surface

SMALL = Field(24, 32, 0.5)


def dome(depth_mm=1.0):
    x, y = SMALL.positions()
    return np.maximum(0, depth_mm - (x * x + y * y) / 12)


def fitted(degree=2, places=3, reaches=(1.0,), seed=0, **limits):
    rng = np.random.default_rng(seed)
    count = (degree * (degree + 3) // 2 + 3 * len(reaches)) * places
    free = {"steepest": 1.0, "left": -1, "right": 1, "top": -1, "bottom": 1}
    free |= {"lowest": (-9.0,) * 3, "highest": (9.0,) * 3}
    rows = tuple(map(tuple, rng.normal(0, 20, (count, 3)).tolist()))
    flat = (100.0, 90.0, 80.0), (5.0, 0.0, 0.0), (0.0, 5.0, 0.0)
    return FittedOptics(degree, places, reaches, rows, 1, flat, FittedLimits(**free | limits))


def test_fitted_colours_are_the_documented_sum():
    model, surface = fitted(reaches=()), Surface(dome(), SMALL)
    picture = model.colours(surface, surface.slopes)
    weights = np.array(model.weights).reshape(5, 3, 3)
    for row, col in ((3, 4), (12, 20), (20, 9)):
        slope = np.array([surface.slopes[0][row, col], surface.slopes[1][row, col]], float)
        nx, ny = -slope / math.sqrt(1 + slope @ slope)
        x, y = (2 * col - 31) / 32, (2 * row - 23) / 24
        expected = np.array([100 + 5 * x, 90 + 5 * y, 80])
        for feature, one in zip((nx, ny, nx * nx, nx * ny, ny * ny), weights, strict=True):
            for place, weight in zip((1, x, y), one, strict=True):
                expected = expected + feature * place * weight
        np.testing.assert_allclose(picture[row, col], expected, atol=0.01)


def test_fitted_colours_are_clipped_to_the_limits_of_the_presses():
    steep = Surface(10 * dome(), SMALL)
    limit = fitted(reaches=(), steepest=0.3)
    gentle = Surface(0.1 * dome(), SMALL)
    free = fitted(reaches=())
    np.testing.assert_allclose(limit.colours(gentle, gentle.slopes), free.colours(gentle, gentle.slopes), atol=1e-3)
    assert np.abs(limit.colours(steep, steep.slopes) - free.colours(steep, steep.slopes)).max() > 10


@pytest.mark.parametrize("name", FITTED)
def test_the_shipped_fits_name_their_source_and_licence_and_stay_small(name):
    content = fitted_optics.fitted_document(name)
    assert "taxim" in content["source"]
    assert "MIT" in content["source"]
    assert len(json.dumps(content)) < 12_000
    load_fitted(name)
