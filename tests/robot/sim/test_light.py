"""Shading and developing in one compiled pass, against the same formulas array by array in float64."""

import numpy as np

from robot.sim.light import GBuffer, Lamps, develop, radiance


def shaded(surfaces, lamps):
    """Return the radiance (n, 3) of `robot.sim.light.radiance`, by the same formulas in numpy, in float64."""
    rays, normals, is_object, visibility, occlusion, colour = (np.asarray(part, float) for part in surfaces)
    is_object = is_object > 0
    lamp_term = np.maximum(normals @ lamps.direction, 0) * visibility
    sky_term = (0.6 + 0.4 * normals[:, 2]) * np.where(is_object, 1, 1 - 0.45 * occlusion)
    half = lamps.direction - rays
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cosine = np.maximum(np.einsum("ij,ij->i", normals, half), 0)
    shine = np.where(is_object, *lamps.gloss) * cosine**lamps.sharpness * (lamp_term > 0)
    light = lamp_term[:, None] * lamps.lamp + sky_term[:, None] * lamps.sky
    return colour * light + shine[:, None] * lamps.lamp


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
