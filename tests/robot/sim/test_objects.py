"""Objects: reproducible, evenly distributed, small enough, with paint independent of tactile properties."""

import numpy as np
import pytest

from robot.sim.objects.appearance import Appearance, Label, draw_appearance
from robot.sim.objects.body import SdfBody
from robot.sim.objects.draw import SimObject, draw_object
from robot.sim.objects.materials import MATERIALS
from robot.sim.objects.relief import RELIEFS, Relief
from robot.sim.objects.shapes import SHAPES
from robot.sim.objects.shapes.revolution import Drum, Revolution


def test_98_objects_show_every_family_and_relief_several_times():
    objects = [draw_object(0, index) for index in range(98)]
    families = [item.family for item in objects]
    reliefs = [item.relief.name for item in objects]
    assert len(SHAPES) >= 12
    assert min(families.count(name) for name in SHAPES) >= 3
    assert min(reliefs.count(name) for name in RELIEFS) >= 6
    assert len({(item.family, item.relief.name) for item in objects}) > 75


def test_colour_is_not_correlated_with_tactile_properties():
    appearance, tactile = [], []
    for item in (draw_object(6, index) for index in range(600)):
        look, relief, size = item.appearance, item.relief, item.body.upper - item.body.lower
        appearance.append([*look.colour, look.paint is None, look.label is None])
        names = list(SHAPES).index(item.family), list(RELIEFS).index(relief.name)
        tactile.append([*names, relief.amplitude_mm, relief.pitch_mm, np.log(item.material.modulus_mpa), *size])
    correlation = np.corrcoef(np.array(appearance, float).T, np.transpose(tactile))[:5, 5:]
    # Of 40 independent pairs of 600 samples, the largest exceeds 0.17 once in a thousand object sets.
    assert np.abs(correlation).max() < 0.17


def test_a_heavy_object_is_hollow_with_a_wall_of_3_mm():
    relief, steel = Relief("smooth", 0.0, 5.0), MATERIALS["steel"]
    body = SdfBody(Revolution((Drum(30, 0, 100),), 100), relief)
    hollow = np.pi * (30**2 * 100 - 27**2 * 94) * 1e-9
    can = SimObject("x", "cylinder", relief, steel, Appearance((1, 1, 1)), body)
    assert can.mass_kg == pytest.approx(hollow * steel.density_kg_m3, rel=0.1)


def test_all_masses_can_be_lifted():
    masses = [draw_object(8, index).mass_kg for index in range(120)]
    assert min(masses) > 1e-3
    assert max(masses) < 3
    assert np.median(masses) < 0.5


def test_colours_are_spread_evenly_over_hue_and_lightness():
    colours = np.array([draw_appearance(np.random.default_rng(seed)).colour for seed in range(600)])
    lightness = (colours.max(axis=1) + colours.min(axis=1)) / 2
    counts = np.histogram(lightness, 7, (0.15, 0.85))[0]
    assert counts.min() > 0.6 * 600 / 7
    strongest = np.bincount(colours.argmax(axis=1), minlength=3)
    assert strongest.min() > 0.27 * 600


def test_a_label_is_a_rectangle_on_one_side_with_lines_of_print():
    label = Label((1, 1, 1), (0, 0, 0), angle_rad=0.0, half_angle_rad=0.5, bottom_mm=20, top_mm=40, line_mm=5)
    appearance = Appearance((0.5, 0.5, 0.5), label=label)
    found = appearance.albedo(np.array([[0.0, -30, 19], [0, -30, 21], [0, -30, 24], [0, 30, 24], [30, 0, 24]]))
    np.testing.assert_array_equal(found[:, 0], [0.5, 0, 1, 0.5, 0.5])
