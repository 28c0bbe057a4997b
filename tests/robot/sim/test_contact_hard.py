"""Stiff and extreme presses: nothing is NaN, contact conditions hold, and the naive formulae fail on the same input."""

import itertools
import math

import numpy as np
import pytest

from robot.sim.contact.constrained_cg import GAP_WEIGHT
from robot.sim.contact.kernels import Operator, influence
from robot.sim.contact.layer import SINGLE_PRECISION_TOLERANCE, Layer, press
from tests.robot.sim.hard_contact import hard_gaps, hard_layers, is_finite


def conditions(gap, layer, contact):
    """Return relative errors of s = 0 in the contact, s >= 0 outside and p >= 0, with u on the whole grid."""
    operator = Operator(influence(gap.shape, layer.thickness_mm, layer.poisson), gap.shape)  # pixels of 1 mm
    displacement = operator(contact.pressure_mpa) / layer.plane_modulus_mpa
    distance = displacement + gap - contact.approach_mm
    touching = contact.pressure_mpa > 0.0
    rounding = 1e-12 * operator.bound * contact.pressure_mpa.max() / layer.plane_modulus_mpa
    scale = max(np.abs(displacement).max(), rounding) or 1.0
    inside = math.sqrt(float(np.mean(distance[touching] ** 2))) if touching.any() else 0.0
    outside = -float(distance[~touching].min(initial=0.0))
    return inside / scale, outside / scale, -float(contact.pressure_mpa.min())


@pytest.mark.parametrize("tolerance", [1e-4, 2 * SINGLE_PRECISION_TOLERANCE])  # products in float64, in float32
@pytest.mark.parametrize("name", hard_gaps())
def test_hard_shapes_meet_the_contact_conditions(name, tolerance):
    gap = hard_gaps()[name]
    for layer, force in itertools.product(hard_layers(), (1e-6, 0.1, 1e4)):
        contact = press(gap, 1.0, layer, force_n=force, tolerance=tolerance)
        assert is_finite(contact)
        assert contact.converged
        assert contact.force_n == pytest.approx(force, rel=1e-9)
        # The difference of gap and approach, both metres, has a rounding error.
        rounding = 1e-13 * abs(contact.approach_mm) / max(contact.displacement_mm.max(), 1e-300)
        assert max(conditions(gap, layer, contact)) <= tolerance / GAP_WEIGHT + 5e-6 + rounding


@pytest.mark.parametrize("softness", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("name", ["ball", "pin", "rough", "plane"])
def test_objects_far_softer_and_far_harder_than_the_gel_are_solved(name, softness):
    for layer in hard_layers():
        modulus = layer.modulus_mpa / softness
        contact = press(hard_gaps()[name], 1.0, layer, force_n=0.1, object_modulus_mpa=modulus)
        assert is_finite(contact)
        assert contact.converged
        assert contact.force_n == pytest.approx(0.1, rel=1e-9)


@pytest.mark.parametrize("depth", [1e-9, 0.3, 1e3])
@pytest.mark.parametrize("name", hard_gaps())
def test_every_depth_is_reached(name, depth):
    for layer in hard_layers():
        contact = press(hard_gaps()[name], 1.0, layer, depth_mm=depth, tolerance=1e-4)
        assert is_finite(contact)
        assert contact.converged
        assert max(conditions(hard_gaps()[name], layer, contact)) <= 1e-5


def test_gaps_too_large_for_float64_are_treated_as_infinite():
    """Block means and gradient steps overflow with gaps of 1e300 mm."""
    far = np.random.default_rng(0).random((60, 50)) < 0.5
    layer = Layer(0.3, 0.5, 1e-6)
    with np.errstate(all="raise", under="ignore"):
        contact, infinite = (press(np.where(far, gap, 0.0), 0.1, layer, force_n=10.0) for gap in (1e300, math.inf))
    assert contact.converged
    assert np.array_equal(contact.pressure_mpa, infinite.pressure_mpa)
