"""From the shape of a gel to its picture: surfaces, LEDs, flaws, markers, noise."""

import math
from dataclasses import replace

import numpy as np
import pytest

from robot.gel_settings import GelSettings
from robot.sim.contact.layer import Layer
from robot.sim.gel import sensor as gel
from robot.sim.gel.fitted_optics import FITTED
from robot.sim.gel.marks import Flaws, Markers, flaw_maps, marker_positions
from robot.sim.gel.optics import LedBar, LedOptics, backdrop_of, cast_shadows
from robot.sim.gel.sensor import OPTICS, GelSensor, Noise, draw_sensor
from robot.sim.gel.surface import Field, Surface, resized

LAYER = Layer(0.3, 0.48, 3.0)
SMALL = Field(24, 32, 0.5)
SILENT = Noise(0.0, 0.0)


def small_sensor(**changes):
    settings = {"field": SMALL, "noise": SILENT, "blur_px": 0.0}
    return GelSensor(LAYER, **{**settings, **changes})


def dome(field=SMALL, radius_mm=6.0, depth_mm=1.0):
    x, y = field.positions()
    return np.maximum(0, depth_mm - (x * x + y * y) / (2 * radius_mm))


@pytest.mark.parametrize("grid", [(24, 32), (12, 16), (30, 40)])
def test_the_slopes_of_a_plane_are_right_on_every_grid(grid):
    field = Field(grid[0], grid[1], 1.0)
    x, y = field.positions()
    across, down = SMALL.size_mm[1] / grid[1], SMALL.size_mm[0] / grid[0]
    slope_x, slope_y = Surface(0.1 * x * across - 0.2 * y * down, SMALL).slopes
    assert slope_x.shape == slope_y.shape == (24, 32)
    np.testing.assert_allclose(slope_x, 0.1, atol=1e-5)
    np.testing.assert_allclose(slope_y, -0.2, atol=1e-5)


def test_slopes_are_interpolated_rather_than_heights_which_would_ripple():
    field, coarse = Field(240, 320, 0.05), Field(60, 80, 0.2)
    x, y = (axis.astype(np.float64) for axis in coarse.positions())
    fine_x, _ = field.positions()
    bowl = (x * x + y * y) / 8
    inside = (slice(20, -20), slice(20, -20))
    ours = Surface(bowl, field).slopes[0]
    truth = np.broadcast_to(fine_x / 4, ours.shape)
    assert np.abs(ours - truth)[inside].max() < 3e-3  # cv2's cubic kernel does not reproduce a straight line exactly


HARD = {
    "one point": np.ones((1, 1)),
    "one row": np.arange(7.0)[None],
    "a cliff of slope 1e6": np.where(np.arange(32) > 16, 5e5, 0.0) * np.ones((24, 1)),
    "beyond every number": np.where(np.arange(32) > 16, 1e300, -1e300) * np.ones((24, 1)),
    "too small for float32": np.full((24, 32), 1e-300),
    "integers": np.eye(24, 32, dtype=np.int64),
    "more points than pixels": np.random.default_rng(0).random((300, 301)),
}


@pytest.mark.parametrize("name", HARD)
@pytest.mark.parametrize("kind", ["led", "grey", "varied", *FITTED])
def test_hard_surfaces_give_pictures(name, kind):
    sensor = replace(draw_sensor(0, "a", optics=kind), field=Field(24, 32, 0.5), markers=Markers())
    clean = sensor._render_surface(Surface(HARD[name], sensor.field))
    assert np.isfinite(clean).all()
    assert clean.min() > -2000
    assert clean.max() < 2000
    picture = sensor.render(HARD[name], 0)
    assert picture.shape == (24, 32, 3)
    assert picture.dtype == np.uint8


def by_two_loops(bar, field, slope_x, slope_y):
    """Return w / w_flat of the module docstring, point by point."""
    out = np.empty((field.rows, field.cols))
    xs, ys = field.positions()
    for row in range(field.rows):
        for col in range(field.cols):
            normal = np.array([-slope_x[row, col], -slope_y[row, col], 1.0])
            normal /= math.sqrt(normal @ normal)
            lit = flat = 0.0
            for led in bar.positions():
                away = led - np.array([xs[0, col], ys[row, 0], 0.0])
                distance = math.sqrt(away @ away)
                axis = -led / math.sqrt(led @ led)
                strength = max(0.0, -axis @ away / distance) ** bar.order / distance**2
                lit += strength * max(0.0, normal @ away / distance)
                flat += strength * away[2] / distance
            out[row, col] = lit / flat
    return out


@pytest.mark.parametrize("points", [1, 4])
def test_light_of_a_bar_is_the_near_field_formula(points):
    field = Field(5, 6, 3.0)
    rng = np.random.default_rng(0)
    slope_x, slope_y = rng.normal(0, 1.5, (2, 5, 6)).astype(np.float32)
    bar = LedBar(math.radians(30), points=points, order=1.7)
    one = LedOptics((bar,) * 3, mix=tuple(map(tuple, np.eye(3))), ambient=0.0, shadow=0.0)
    flat = Surface(np.zeros((5, 6)), field)
    light = one.colours(flat, (slope_x, slope_y))[..., 1] / backdrop_of(one.backdrops, field)[..., 1]
    np.testing.assert_allclose(light, by_two_loops(bar, field, slope_x, slope_y), rtol=1e-4, atol=1e-5)
    assert (light == 0).any() or points > 1


def test_the_side_of_a_bump_towards_a_bar_has_its_colour():
    sensor = small_sensor(optics=LedOptics(shadow=0.0))
    change = sensor.render(dome(), 0).astype(int) - sensor.background(0)
    rows, cols = np.indices((24, 32))
    x, y = cols - 15.5, rows - 11.5
    for channel, bar in enumerate(sensor.optics.bars):
        towards = x * math.cos(bar.angle_rad) - y * math.sin(bar.angle_rad)
        near = (np.hypot(x, y) < 6) & (np.abs(towards) > 3)
        assert change[near & (towards > 0), channel].mean() > 10
        assert change[near & (towards < 0), channel].mean() < -10


def test_a_bump_casts_a_shadow_away_from_the_bar_and_a_flat_gel_none():
    field = Field(80, 80, 0.1)
    bump = np.zeros((80, 80))
    bump[36:44, 36:44] = 1.0
    (shade,) = cast_shadows(Surface(bump, field), (LedBar(0.0, height_mm=4.0),))
    assert shade[40, 26] > 0.3
    assert shade[40, 60] < 0.01
    assert 0 <= shade.min() <= shade.max() <= 1
    assert not cast_shadows(Surface(np.zeros((4, 4)), field), (LedBar(0.0),))[0].any()


@pytest.mark.parametrize("kind", OPTICS)
def test_a_flat_gel_shows_the_backdrop_and_render_of_nothing_is_the_background(kind):
    sensor = replace(draw_sensor(1, "a", optics=kind), flaws=None, blur_px=0.0, tint=(1.0, 1.0, 1.0), exposure=1.0)
    sensor = replace(sensor, markers=None, detail=1.0, jpeg_quality=None)
    if isinstance(sensor.optics, LedOptics):
        backdrop = backdrop_of(sensor.optics.backdrops, sensor.field)
        np.testing.assert_allclose(sensor.render_clean(np.zeros((3, 4))), backdrop, atol=1e-3)
        quiet = replace(sensor, noise=SILENT).background(0)
        assert np.abs(quiet - np.clip(np.rint(backdrop), 0, 255)).max() <= 1  # a tie may round either way
    for flat in (np.zeros((240, 320)), np.zeros((1, 1)), np.zeros((7, 9), np.float32)):
        np.testing.assert_array_equal(sensor.render(flat, 5), sensor.background(5))


def test_noise_has_the_documented_variance():
    sensor = GelSensor(LAYER, noise=Noise(1.5, 0.02))
    many = np.stack([sensor.background(seed) for seed in range(60)]).astype(float)
    clean = gel._no_contact_image(sensor)
    expected = 1.5**2 + 0.02 * clean + 1 / 12  # rounding adds 1/12
    assert np.mean(many.var(axis=0)) == pytest.approx(expected.mean(), rel=0.05)


def test_drawn_sensors_differ_by_seed_and_finger_and_known_settings_replace_drawn_ones_only():
    drawn = draw_sensor(4, "a")
    assert drawn == draw_sensor(4, "a") == draw_sensor(4, "a", gel=GelSettings())
    sensors = {draw_sensor(seed, finger) for seed in range(5) for finger in "ab"}
    assert len(sensors) == 10
    for sensor in sensors:
        assert 0.2 <= sensor.layer.modulus_mpa <= 0.8
        assert 0.45 <= sensor.layer.poisson <= 0.49
        assert 2 <= sensor.layer.thickness_mm <= 4
        background = sensor.background(0)
        assert np.mean((background <= 5) | (background >= 250)) < 0.01
        assert 60 < background.mean() < 170
    changed = draw_sensor(4, "a", gel=GelSettings(thickness_mm=2.5, modulus_mpa=0.3))
    assert changed == replace(drawn, layer=replace(drawn.layer, thickness_mm=2.5, modulus_mpa=0.3))
    assert changed.gel == GelSettings(2.5, 0.3, drawn.layer.poisson)


def test_gamma_is_the_exponent_of_the_light_relative_to_the_flat_gel():
    plain, steep = (small_sensor(optics=LedOptics(gamma=gamma, shadow=0.0)) for gamma in (1.0, 2.0))
    surface = Surface(dome(), SMALL)
    backdrop = backdrop_of(plain.optics.backdrops, SMALL)
    light = plain.optics.colours(surface, surface.slopes) / backdrop
    np.testing.assert_allclose(steep.optics.colours(surface, surface.slopes), backdrop * light**2, rtol=1e-4)
    flat = Surface(np.zeros((1, 1)), SMALL)
    np.testing.assert_allclose(steep.optics.colours(flat, flat.slopes), backdrop, rtol=1e-4)


def test_a_camera_of_less_detail_blurs_noise_and_compression_changes_the_picture_slightly():
    sensor = draw_sensor(2, "a")
    sharp, reduced, compressed = (
        replace(sensor, **change).background(3).astype(float) for change in ({}, {"detail": 0.25}, {"jpeg_quality": 60})
    )
    roughness = [np.abs(np.diff(picture, axis=1)).mean() for picture in (sharp, reduced)]
    assert roughness[1] < 0.5 * roughness[0]
    assert abs(reduced.mean() - sharp.mean()) < 1
    assert 0 < np.abs(compressed - sharp).mean() < 4


def test_varied_sensors_have_any_number_of_lamps_colours_markers_and_cameras():
    sensors = [draw_sensor(seed, "a", optics="varied") for seed in range(60)]
    assert sensors[7] == draw_sensor(7, "a", optics="varied")
    assert len(set(sensors)) == 60
    assert {len(sensor.optics.bars) for sensor in sensors} == set(range(1, 7))
    for kinds in (
        {len(set(sensor.optics.backdrops)) == 1 for sensor in sensors},
        {sensor.markers is None for sensor in sensors},
        {sensor.detail < 1 for sensor in sensors},
        {sensor.jpeg_quality is None for sensor in sensors},
    ):
        assert kinds == {True, False}
    for sensor in sensors[:20]:
        small = replace(sensor, field=Field(48, 64, 5 * sensor.field.pixel_mm))
        assert 10 < small.background(0).mean() < 245


def test_flaws_stay_in_place_and_do_not_move_with_the_size_of_the_picture():
    flaws = Flaws(3, specks=5, hairs=2, grains=4, texture=0.0)
    fine, coarse = (flaw_maps(flaws, field) for field in (Field(480, 640, 0.03), Field(240, 320, 0.06)))
    np.testing.assert_allclose(resized(fine[0], (240, 320)), coarse[0], atol=0.25)
    assert coarse[0].min() < 0.95
    assert 0 < np.abs(coarse[1]).max() < 0.5
    clean = flaw_maps(Flaws(3, 0, 0, 0, 0.0), SMALL)
    assert (clean[0] == 1).all()
    assert not clean[1].any()


def test_markers_rest_on_a_grid_and_a_press_spreads_them():
    field, markers = Field(240, 320, 0.0634), Markers(pitch_mm=2.0)
    rest = marker_positions(markers, Surface(np.zeros((1, 1)), field))
    assert len(rest) == 7 * 10
    np.testing.assert_allclose(rest.mean(axis=0), 0, atol=1e-5)
    moved = marker_positions(markers, Surface(dome(field, 3.0, 0.8), field)) - rest
    outwards = (moved * rest).sum(axis=1) / np.linalg.norm(rest, axis=1)
    near = np.linalg.norm(rest, axis=1) < 3
    assert (outwards[near] > 0.02).all()
    assert np.abs(moved[np.linalg.norm(rest, axis=1) > 7]).max() < 0.01
    assert np.abs(moved).max() < 0.5
