"""Influence of pressure on an elastic surface: against limits, quadrature and plain loops."""

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j0

from robot.sim.contact.kernels import (
    THIN_PIXELS,
    Operator,
    influence,
    layer_compliance,
    layer_correction,
    layer_symbol,
    love_patch,
)
from tests.robot.sim.hard_contact import naive_symbol

POISSON = (-0.9, 0.0, 0.3, 0.48, 0.5)


def by_loops(table, pressure):
    """Return the displacement, summed over each pixel's pressure."""
    total = np.zeros(pressure.shape)
    for (i, j), (k, m) in itertools.product(np.ndindex(pressure.shape), repeat=2):
        total[k, m] += pressure[i, j] * table[abs(k - i), abs(m - j)]
    return total


@pytest.mark.parametrize("poisson", POISSON)
def test_far_thinner_than_the_wave_a_layer_is_springs_of_its_confined_modulus(poisson):
    # u = p h / M with M = E (1-v) / ((1+v)(1-2v)); in units of E* = E / (1-v^2) that is h (1-2v) / (1-v)^2.
    q = np.array([0.0, 1e-9, 1e-7])
    springs = 2.0 * (1.0 - 2.0 * poisson) / (1.0 - poisson) ** 2
    assert layer_compliance(q, 2.0, poisson) == pytest.approx(springs, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("poisson", POISSON)
def test_the_layer_formula_equals_the_printed_one_where_that_is_computable(poisson):
    x = np.array([0.05, 0.2, 0.24999, 0.25001, 0.5, 1.0, 3.0, 10.0])
    assert layer_symbol(x, poisson) == pytest.approx(naive_symbol(x, poisson), rel=1e-11)


@pytest.mark.parametrize("poisson", POISSON)
@pytest.mark.parametrize("rho", [0.0, 2.0])
def test_the_correction_is_the_documented_transform(poisson, rho):
    exact = quad(lambda x: (1.0 - layer_symbol(np.array([x]), poisson)[0]) * j0(x * rho), 0.0, 25.0, limit=400)[0]
    assert float(layer_correction(poisson)(rho)) == pytest.approx(exact, abs=1e-8)  # quad has an error of 1.5e-8


@pytest.mark.parametrize(("row", "col"), [(0, 2), (1, 1), (3, 5)])
def test_love_s_patch_is_the_sum_of_point_forces_over_the_pixel(row, col):
    nodes, weights = np.polynomial.legendre.leggauss(20)
    total = 0.0
    for y, wy in zip(nodes / 2.0, weights / 2.0, strict=True):
        for x, wx in zip(nodes / 2.0, weights / 2.0, strict=True):
            total += wy * wx / (math.pi * math.hypot(row + y, col + x))
    assert love_patch((4, 6))[row, col] == pytest.approx(total, rel=1e-12)


@pytest.mark.parametrize("poisson", POISSON)
def test_pixels_and_waves_agree_at_the_switch_between_them(poisson):
    x = np.arange(48) - 24.0
    pressure = np.exp(-(x[:, None] ** 2 + x**2) / (2.0 * 5.0**2))
    just_thin, just_thick = (
        Operator(influence((48, 48), THIN_PIXELS * factor, poisson), (48, 48))(pressure) for factor in (0.999999, 1.0)
    )
    # A pixel's uniform pressure differs from a smooth one by (pixel / scale)^2 / 24, .2 %.
    assert just_thin == pytest.approx(just_thick, abs=3e-3 * just_thick.max())


@pytest.mark.parametrize("thickness", [math.inf, 4.0, 0.5])
@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (5, 1), (4, 7), (8, 8)])
def test_the_operator_is_the_sum_over_pixels(thickness, shape):
    pressure = np.random.default_rng([1, *shape]).random(shape)
    table = influence(shape, thickness, 0.48)
    assert Operator(table, shape)(pressure) == pytest.approx(by_loops(table, pressure), abs=1e-13)


def test_a_window_does_not_wrap_around_and_is_a_corner_of_the_grid():
    table = influence((9, 11), 4.0, 0.48)
    pressure = np.random.default_rng([2]).random((3, 5))
    large = np.zeros((9, 11))
    large[4:7, 2:7] = pressure
    inside = Operator(table, (9, 11))(large)[4:7, 2:7]
    assert Operator(table, (3, 5))(pressure) == pytest.approx(inside, abs=1e-13)


@pytest.mark.parametrize("thickness", [math.inf, 20.0, 2.0, 1.0, 0.05])
@pytest.mark.parametrize("poisson", [-0.9, 0.5])
def test_the_operator_is_symmetric_positive_and_within_its_bound(thickness, poisson):
    shape = (12, 9)
    operator = Operator(influence(shape, thickness, poisson), shape)
    columns = np.array([operator(unit.reshape(shape)).ravel() for unit in np.eye(shape[0] * shape[1])])
    values = np.linalg.eigvalsh(columns)
    assert columns == pytest.approx(columns.T, abs=1e-14 * operator.bound)
    assert values[0] > 0.0
    assert values[-1] <= operator.bound * (1.0 + 1e-12)
