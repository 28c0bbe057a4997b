"""Stiff and extreme presses: nothing is NaN, contact conditions hold, and the naive formulae fail on the same input."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.sim.contact.constrained_cg import GAP_WEIGHT, ContactProblem, project_to_simplex
from robot.sim.contact.kernels import Operator, influence
from robot.sim.contact.layer import SINGLE_PRECISION_TOLERANCE, Layer, press
from tests.robot.sim.hard_contact import hard_gaps, hard_layers, is_finite, naive_solve

# Contact conditions, checked independently of the solver ---------------------------------------------------


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


@settings(max_examples=30)
@given(data=st.data())
def test_any_small_map_is_solved(data):
    shape = data.draw(st.tuples(st.integers(1, 7), st.integers(1, 7)))
    heights = st.one_of(st.floats(0.0, 2.0), st.sampled_from([0.0, math.inf, 1e-12, 1e6]))
    gap = np.array(data.draw(st.lists(heights, min_size=shape[0] * shape[1], max_size=shape[0] * shape[1])))
    gap = gap.reshape(shape)
    layer = data.draw(st.sampled_from(hard_layers()))
    force = 10.0 ** data.draw(st.floats(-6.0, 4.0))
    contact = press(gap, 1.0, layer, force_n=force)
    assert is_finite(contact)
    assert contact.converged == bool(np.isfinite(gap).any())
    if contact.converged:
        assert contact.force_n == pytest.approx(force, rel=1e-9)
        assert max(conditions(gap, layer, contact)) <= 2e-4


# A pin that yields -----------------------------------------------------------------------------------------


def test_a_pin_and_its_plate_carry_the_pressures_computed_by_hand():
    # Two pixels, the pin and one neighbour: K [p, q] + [0, g] = d [1, 1], p + q = F.
    layer, force, step = Layer(0.75, 0.5), 1.0, 0.1
    own, other = influence((1, 2), math.inf, 0.5)[0]
    # (own - other) (p - q) = g
    difference = step / (own - other)
    contact = press(np.array([[0.0, step]]), 1.0, layer, force_n=force, tolerance=1e-10)
    assert contact.pressure_mpa[0] == pytest.approx([(force + difference) / 2.0, (force - difference) / 2.0], rel=1e-8)
    assert contact.approach_mm == pytest.approx(own * contact.pressure_mpa[0, 0] + other * contact.pressure_mpa[0, 1])


def test_without_the_safeguard_the_pin_cycles_and_with_it_the_energy_never_rises():
    gap = np.full((32, 32), 0.1)
    gap[16, 16] = 0.0
    operator = Operator(influence(gap.shape, math.inf, 0.5), gap.shape)
    _, naive = naive_solve(operator, gap, 0.1, max_iterations=500)
    assert naive == 500
    problem = ContactProblem(operator, gap, load=0.1)
    start, energies = problem.initial_pressure(), []
    for steps in range(0, 60, 3):
        pressure = problem.solve(start, 1e-12, steps).pressure
        energies.append(0.5 * float(np.vdot(pressure, operator(pressure))) + float(np.vdot(pressure, gap)))
    assert all(later <= earlier * (1.0 + 1e-12) for earlier, later in itertools.pairwise(energies))


def test_the_nearest_pressure_of_a_given_sum_beats_every_other():
    values = np.array([3.0, -1.0, 0.5, 2.0])
    nearest = project_to_simplex(values, 2.0)
    # By hand: 3 and 2 remain, each less 1.5; the others become 0.
    assert nearest == pytest.approx([1.5, 0.0, 0.0, 0.5])
    rng = np.random.default_rng([7])
    others = rng.dirichlet(np.ones(4), 200) * 2.0
    assert (np.linalg.norm(others - values, axis=1) >= np.linalg.norm(nearest - values)).all()
