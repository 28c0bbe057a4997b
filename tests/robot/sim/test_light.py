"""Shading and developing in one compiled pass, against the same formulas array by array in float64."""

import numpy as np

from benchmarks.frontier.light import shaded
from robot.sim.light import GBuffer, Lamps, develop, radiance


def surfaces_and_lamps(count=5000, seed=0):
    rng = np.random.default_rng(seed)
    unit = rng.standard_normal((3, count, 3))
    unit /= np.linalg.norm(unit, axis=2, keepdims=True)
    fractions = rng.uniform(size=(2, count)).astype(np.float32)
    is_object, colour = rng.uniform(size=count) < 0.5, rng.uniform(size=(count, 3)).astype(np.float32)
    colour[:7] = 0
    surfaces = GBuffer(unit[0], unit[1].astype(np.float32), is_object, *fractions, colour)
    return surfaces, Lamps(unit[2, 0], np.array([0.9, 0.8, 0.7]), np.array([0.2, 0.25, 0.3]), (1.1, 0.04), 60.0)


def test_radiance_is_that_of_lambert_blinn_and_the_sky():
    surfaces, lamps = surfaces_and_lamps()
    ours, exact = radiance(surfaces, lamps), shaded(surfaces, lamps)
    np.testing.assert_allclose(ours, exact, atol=2e-6, rtol=1e-5)  # sixty times a float32 logarithm


def test_grey_levels_follow_the_gamma_and_are_clipped():
    linear = np.float32([[[0, 0.5, 1], [1.5, 1e-7, 0.25]]])
    flat = develop(linear, np.zeros((1, 2, 3)))
    np.testing.assert_array_equal(flat, [[[0, 186, 255], [255, 0, 136]]])  # 255 * 0.5^(1/2.2) = 186.08, 135.79
    noisy = develop(linear, np.array([[[-3.0, 2.0, 5.0], [-7.0, 300.0, -200.0]]]))
    np.testing.assert_array_equal(noisy, [[[0, 188, 255], [248, 255, 0]]])
