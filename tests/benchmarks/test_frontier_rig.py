"""Error against run time: the content of points, and errors that fall as expected."""

import math

import pytest

from benchmarks.frontier.closed_forms import hertz
from benchmarks.frontier.contact import contact_panels, products_panel
from benchmarks.frontier.light import light_panel, sky_panel
from benchmarks.frontier.optics import optics_panel
from benchmarks.frontier.rays import gel_panel, limit_panel, photo_panel
from robot.sim.objects.packets import MAX_STEPS


@pytest.fixture(scope="module")
def panels():
    """Panels of the half-space, the layer and the gel image."""
    return contact_panels(1, rows=(15, 30), tolerances=(1e-1, 1e-3), reference_rows=120)


def errors(panel, *words):
    return [point.error for point in panel.points if all(word in point.name for word in words)]


def test_every_point_has_its_error_time_and_reference(panels):
    assert [len(panel.points) for panel in panels] == [2 * 2] * 3
    for panel in panels:
        assert all((panel.title, panel.time, panel.unit, panel.reference))
        for point in panel.points:
            assert point.seconds > 0.0
            assert math.isfinite(point.error)
        assert len({point.name for point in panel.points}) == len(panel.points)


def test_a_finer_grid_is_nearer_to_hertz_and_to_the_finest_grid(panels):
    for panel in panels:
        coarse, fine = (
            error
            for point, error in zip(panel.points, errors(panel, ""), strict=True)
            if point.setting == "tolerance 0.001"
        )
        assert fine < coarse


def test_hertz_by_hand():
    # F = 4/3 E* sqrt(R) d^1.5 with R = 4, d = .25, E* = .3: 4/3 * .3 * 2 * .125 = .1 N; a = sqrt(R d) = 1.
    a, depth, peak = hertz(0.1, 4.0, 0.3)
    assert (a, depth, peak) == pytest.approx((1.0, 0.25, 0.15 / math.pi))


def test_the_optics_have_a_point_for_each_degree_and_error_falls():
    panel = optics_panel(1, "gelsight_mini")
    assert [point.name for point in panel.points] == [f"gelsight_mini, degree {degree}" for degree in (1, 2, 3, 4)]
    first, second, third, _ = panel.points
    assert first.error > second.error > third.error > 1
    assert all(point.seconds > 0 for point in panel.points)


def test_shorter_gel_steps_have_smaller_errors_and_the_default_is_within_tolerance():
    panel = gel_panel(1, rows=12, steps_mm=(1.6, 0.8, 0.1))
    long, middle, gels = errors(panel, "")
    assert long > 1.5 * middle > 1e3 * gels > 0
    assert gels < panel.tolerance
    assert panel.default.setting == "0.1 mm"


def test_shorter_photo_steps_have_smaller_errors_and_the_default_is_below_camera_noise():
    panel = photo_panel(1, objects=2, px=64, strides=(16, 4, 1))
    assert panel.default.name == "as the rig casts, 1 px"
    long, middle, ours = errors(panel, "as the rig casts")
    assert long > 2 * middle > 4 * ours
    assert ours < panel.tolerance
    assert errors(panel, "equal steps")[-1] == 0


def test_few_steps_lose_rays_and_the_default_number_loses_none():
    panel = limit_panel(1, objects=2, px=64, limits=(4, 8, 12, MAX_STEPS))
    *few, ours = errors(panel, "")
    assert few[0] > few[1] > few[2] > ours == 0
    assert panel.default.setting == "600 steps"


def test_float32_and_float64_shading_differ_by_at_most_a_grey_level():
    panel = light_panel(1, objects=2, px=64)
    compiled, arrays, exact = errors(panel, "")
    assert compiled <= 1
    assert arrays <= 1
    assert exact == 0
    assert panel.default.name == "float32, compiled"


def test_the_sky_on_a_finer_grid_is_nearer_to_the_full_one():
    found = errors(sky_panel(1, px=128), "")
    assert found == sorted(found, reverse=True)
    assert found[2] < 1.0


def test_float32_changes_a_contact_by_less_than_its_tolerance():
    panel = products_panel(1, rows=60, tolerances=(1e-2,))
    double, single = errors(panel, "")
    assert double == pytest.approx(single, rel=0.02)
    assert panel.default.name == "float32, tolerance 0.01"
