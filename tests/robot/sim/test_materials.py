"""Materials: the table and its spread, and paint that is independent of both."""

import numpy as np

from robot.sim.objects.appearance import Appearance, Label, draw_appearance

# Appearance ------------------------------------------------------------------------------------------------


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
