"""The contact solver: closed forms, another solver on small grids, units, soft objects, flags and wrong input."""

import math

import numpy as np
import pytest
from scipy.optimize import nnls

from benchmarks.frontier.closed_forms import closed_form_table
from robot.errors import SceneError
from robot.sim.contact.kernels import influence
from robot.sim.contact.layer import Layer, press

HALF_SPACE = Layer(0.2, 0.48)
GEL = Layer(0.2, 0.48, 2.0)
PIXEL = 0.12


def bowl(rows=40, cols=48, radius=4.0, pixel=PIXEL):
    y, x = (pixel * (np.arange(n) - (n - 1) / 2.0) for n in (rows, cols))
    return (y[:, None] ** 2 + x**2) / (2.0 * radius)


def matrix(layer, shape, pixel):
    """Return the displacement of each pixel (mm) by unit pressure (MPa) on each other one, entry by entry."""
    table = influence(shape, layer.thickness_mm / pixel, layer.poisson) * pixel / layer.plane_modulus_mpa
    cells = [(i, j) for i in range(shape[0]) for j in range(shape[1])]
    return np.array([[table[abs(i - k), abs(j - m)] for i, j in cells] for k, m in cells])


def test_the_solver_is_within_the_tolerance_of_every_closed_form():
    assert [f"{c.case}, {c.quantity}, {c.grid}: {c.error}" for c in closed_form_table() if not c.holds] == []


@pytest.mark.parametrize("layer", [HALF_SPACE, GEL, Layer(0.2, 0.5, 0.3), Layer(0.2, 0.0, 0.05), Layer(5.0, 0.3, 1.0)])
@pytest.mark.parametrize("kind", ["ball", "rough", "holes"])
def test_pressure_is_that_of_an_active_set_method(layer, kind):
    # min 1/2 p.K p + p.(gap - d), p >= 0, is a least squares problem with K's Cholesky factor.
    shape, depth = (9, 8), 0.1
    rough = np.random.default_rng([5]).random(shape) * 0.2
    gap = {"ball": bowl(*shape, radius=1.0), "rough": rough, "holes": np.where(rough > 0.1, np.inf, rough)}[kind]
    has_object = np.isfinite(gap).ravel()
    factor = np.linalg.cholesky(matrix(layer, shape, PIXEL)[np.ix_(has_object, has_object)])
    expected = np.zeros(gap.size)
    expected[has_object] = nnls(factor.T, np.linalg.solve(factor, depth - gap.ravel()[has_object]))[0]
    contact = press(gap, PIXEL, layer, depth_mm=depth, tolerance=1e-9)
    assert contact.converged
    assert contact.pressure_mpa.ravel() == pytest.approx(expected, abs=1e-6 * expected.max())  # K has condition 1e3
    assert contact.force_n == pytest.approx(expected.sum() * PIXEL**2, rel=1e-8)


def test_displacement_is_the_influence_of_the_pressure():
    gap = bowl(12, 10)
    contact = press(gap, PIXEL, GEL, force_n=0.05)
    exact = matrix(GEL, gap.shape, PIXEL) @ contact.pressure_mpa.ravel()
    assert contact.displacement_mm.ravel() == pytest.approx(exact, rel=1e-10)


def test_a_needle_missed_by_the_coarse_grid_is_found():
    # A needle of one pixel is 1/16 of its coarse pixel: in the mean it is far away.
    gap = bowl(64, 64)
    gap[5, 60] = -0.05
    contact = press(gap, PIXEL, GEL, force_n=0.2, tolerance=1e-6)
    assert contact.converged
    assert contact.pressure_mpa[5, 60] > 0.0
    assert contact.pressure_mpa[31, 31] > 0.0
    distance = contact.displacement_mm + gap - contact.approach_mm
    assert distance.min() > -1e-6 * contact.displacement_mm.max()


@pytest.mark.parametrize("layer", [HALF_SPACE, GEL])
def test_metres_newtons_and_pascals_give_the_same_contact(layer):
    in_mm = press(bowl(), PIXEL, layer, force_n=0.3)
    si = Layer(layer.modulus_mpa * 1e6, layer.poisson, layer.thickness_mm * 1e-3)
    in_m = press(bowl() * 1e-3, PIXEL * 1e-3, si, force_n=0.3)
    assert in_m.iterations == in_mm.iterations
    assert in_m.pressure_mpa == pytest.approx(in_mm.pressure_mpa * 1e6, rel=1e-9)
    assert in_m.displacement_mm == pytest.approx(in_mm.displacement_mm * 1e-3, rel=1e-9)


def test_two_half_spaces_touch_like_one_of_the_composite_modulus():
    # 1/E* = (1 - .48^2)/.2 + (1 - .3^2)/.5
    composite = 1.0 / ((1.0 - 0.48**2) / 0.2 + (1.0 - 0.3**2) / 0.5)
    soft = press(bowl(), PIXEL, HALF_SPACE, force_n=0.3, object_modulus_mpa=0.5, object_poisson=0.3)
    rigid = press(bowl(), PIXEL, Layer(composite, 0.0), force_n=0.3)
    assert soft.pressure_mpa == pytest.approx(rigid.pressure_mpa, rel=1e-9)
    assert soft.approach_mm == pytest.approx(rigid.approach_mm, rel=1e-9)
    # The gel's part of the displacement is its part of the compliance.
    fraction = composite * (1.0 - 0.48**2) / 0.2
    assert soft.displacement_mm == pytest.approx(fraction * rigid.displacement_mm, rel=1e-9)


def test_a_softer_object_touches_more_and_indents_less():
    presses = [press(bowl(), PIXEL, GEL, force_n=0.3, object_modulus_mpa=e) for e in (0.01, 0.2, 2e5, math.inf)]
    assert all(contact.converged for contact in presses)
    assert [c.area_mm2 for c in presses] == sorted((c.area_mm2 for c in presses), reverse=True)
    assert [c.displacement_mm.max() for c in presses] == sorted(c.displacement_mm.max() for c in presses)
    assert presses[2].displacement_mm == pytest.approx(presses[3].displacement_mm, rel=1e-4)


def test_a_resolved_light_press_has_no_flags():
    contact = press(bowl(), PIXEL, GEL, force_n=0.3)
    assert contact.flags == ()
    assert contact.converged
    assert contact.residual <= 1e-3
    assert contact.force_n == pytest.approx(0.3, rel=1e-12)
    assert contact.area_mm2 == pytest.approx((contact.pressure_mpa > 0.0).sum() * PIXEL**2)


@pytest.mark.parametrize(
    ("flag", "gap", "options"),
    [
        ("unresolved", bowl(), {"force_n": 1e-6}),
        ("at_border", bowl()[:, 20:], {"force_n": 0.3}),
        ("large_strain", bowl(), {"force_n": 5.0}),
        ("steep", bowl(radius=1.0), {"force_n": 2.0}),
        ("no_contact", bowl(), {"force_n": 0.0}),
        ("no_contact", bowl(), {"depth_mm": -1.0}),
    ],
)
def test_untrustworthy_results_are_flagged(flag, gap, options):
    contact = press(gap, PIXEL, GEL, **options)
    assert contact.converged
    assert flag in contact.flags


def test_early_stop_is_flagged_and_carries_the_force():
    contact = press(bowl(), PIXEL, GEL, force_n=0.3, tolerance=1e-8, max_iterations=3)
    assert not contact.converged
    assert "iteration_cap" in contact.flags
    assert contact.iterations == 3
    assert contact.residual > 1e-8
    assert contact.force_n == pytest.approx(0.3, rel=1e-12)


@pytest.mark.parametrize(("gap", "force_n", "message"), [(np.nan, 1.0, "got NaN"), (0.0, 1e-300, "consistent units")])
def test_wrong_input_is_refused_with_a_message(gap, force_n, message):
    with pytest.raises(SceneError, match=message):
        press(np.full((3, 3), gap), PIXEL, GEL, force_n=force_n)
