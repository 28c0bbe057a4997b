"""Formulas against the numpy functions that they were recorded from; a body in packets against plain numpy."""

import numba
import numpy as np
import pytest

from robot.sim.jit import jit
from robot.sim.objects.draw import draw_object
from robot.sim.objects.formula import trace_formula
from robot.sim.objects.packets import LANES, OPERATIONS, evaluate_formula
from robot.sim.objects.shapes import SHAPES
from robot.sim.objects.shapes.shape import arctan2, rounded_corner

SIZES = (1, LANES - 1, LANES, LANES + 1, 5 * LANES + 7)


def numbers(count, size, seed=0):
    return list(np.random.default_rng(seed).normal(0, 20, (count, size)).astype(np.float32))


def everything(a, b):
    """Use each operation once, and constants of every kind."""
    inside = np.where(np.abs(a) > np.float32(3), b, 2.0 * a)
    angle = np.copysign(np.rint(inside / 7), -b)
    angle *= 0.5
    waves = np.sin(angle) + np.cos(angle) - np.minimum(a, b) * (a < b)
    return (
        np.sqrt(np.maximum(waves, 0)) + np.exp(-np.abs(a)),
        np.log1p(np.abs(b)) + np.log(np.abs(a) + 1),
        np.clip(a, -1, 1),
    )


@pytest.mark.parametrize("size", SIZES)
def test_a_formula_gives_the_result_of_its_function(size):
    operands = numbers(2, size)
    formula = trace_formula(everything, 2)
    for ours, exact in zip(evaluate_formula(formula, *operands), everything(*operands), strict=True):
        np.testing.assert_allclose(ours, exact, rtol=3e-6, atol=1e-6)
    assert {OPERATIONS[name] for name in formula.code[:, 0]} == set(OPERATIONS)


def test_exactly_rounded_operations_are_bitwise_equal_for_any_number():
    def compared(a, b):
        return np.maximum(np.minimum(a, 2), -2) + np.where(a > b, np.abs(a), b)

    operands = numbers(2, 1000)
    extreme = np.array([np.inf, -np.inf, 3.4e38, -3.4e38, 0.0, -0.0, 1e-45, 2.0, -2.0], np.float32)
    for function in (lambda a, b: rounded_corner(a, b, 1.5), arctan2, compared):
        np.testing.assert_array_equal(evaluate_formula(trace_formula(function, 2), *operands)[0], function(*operands))
    pairs = [each.ravel() for each in np.meshgrid(extreme, np.array([0.0, 3.0, -1e-45], np.float32))]
    np.testing.assert_array_equal(evaluate_formula(trace_formula(compared, 2), *pairs)[0], compared(*pairs))


@pytest.mark.parametrize("family", SHAPES)
def test_every_family_is_the_same_in_packets_and_in_numpy(family):
    body = draw_object(3, 5, family=family, relief="knurl").body
    rng = np.random.default_rng(1)
    points = rng.uniform(body.lower - 3, body.upper + 3, (2000, 3)).astype(np.float32).T
    for function in (body.shape.distance_xyz, body.chart_coordinates):
        exact = function(*points)
        packets = evaluate_formula(trace_formula(function, 3), *points)
        for ours, numpys in zip(packets, np.atleast_2d(exact), strict=True):
            np.testing.assert_allclose(ours, numpys, atol=5e-5)  # float32 sines and powers of about 100 mm


def test_hits_do_not_depend_on_the_order_of_rays():
    body = draw_object(0, 14).body
    width = np.linspace(*body.lower[[0]], *body.upper[[0]], 400)
    origins = np.stack([width, np.full(400, -300.0), np.full(400, 0.5 * body.upper[2])], axis=1)
    directions = np.broadcast_to([0.0, 1.0, 0.0], origins.shape)
    order = np.random.default_rng(0).permutation(400)
    found = body.cast(origins, directions)
    np.testing.assert_array_equal(body.cast(origins[order], directions), found[order])
    assert np.isfinite(found).sum() > 100


def test_code_without_a_cache_folder_is_compiled_in_the_process():
    function = eval("lambda a: a + 1")  # it is in no file, so there is no folder for its cache
    with pytest.raises(RuntimeError, match="no locator"):
        numba.njit(cache=True)(function)
    assert jit(function)(2) == 3
