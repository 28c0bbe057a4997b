"""Shapes: distances by hand, the bound for sphere tracing, sizes that fit the gripper, unrolled walls."""

import numpy as np
import pytest

from robot.sim.objects.shapes import SHAPES
from robot.sim.objects.shapes.extrusion import Extrusion, Polygon, RoundedRectangle
from robot.sim.objects.shapes.revolution import Ball, Cone, Drum, Revolution, ThreadedRod
from robot.sim.objects.shapes.shape import CylindricalChart, arctan2
from robot.sim.objects.shapes.solids import Brick, Brush, Comb, Ring, Superquadric, TwoSidedChart


def draw(family, seed):
    return SHAPES[family](np.random.default_rng(seed))


def distance(shape, *points):
    return shape.distance(np.array(points, float))


def test_distances_from_a_hexagon_are_those_of_its_faces_and_corners():
    shape = Extrusion(Polygon(6, 20, 3), 50, rim_mm=0)
    corner = 17 / np.cos(np.pi / 6) + 3
    found = distance(shape, [0, -25, 25], [0, 27, 25], [-corner - 4, 0, 25], [0, 0, 25])
    np.testing.assert_allclose(found, [5, 7, 4, -20], atol=1e-5)
    np.testing.assert_allclose(shape.upper[0], corner)


def test_distances_from_a_ball_a_cone_a_ring_and_a_link():
    np.testing.assert_allclose(distance(Revolution((Ball(15, 15),), 30), [0, -20, 15], [9, 12, 15]), [5, 0], atol=1e-5)
    cone = Revolution((Cone(20, 10, 0, 40),), 40)
    # Halfway up, the radius is 15; the side leans by 1 in 4.
    np.testing.assert_allclose(distance(cone, [16, 0, 20]), [1 / np.hypot(1, 0.25)], atol=1e-5)
    ring = Ring(20, 5, stretch_mm=30)
    found = distance(ring, [30, 0, ring.middle_mm], [20, 8, ring.middle_mm + 15], [0, 0, ring.middle_mm])
    np.testing.assert_allclose(found, [5, 3, 15], atol=1e-5)


def test_the_distance_from_an_ellipsoid_is_exact_for_a_ball_and_never_too_large():
    ball = Superquadric((20, 20, 20))
    np.testing.assert_allclose(distance(ball, [0, -31, ball.middle_mm]), [11], atol=1e-5)
    long = Superquadric((20, 20, 60))
    assert 0 < distance(long, [0, 0, long.upper[2] + 10])[0] <= 10


def test_slots_and_bristles_follow_their_pitch():
    slab = Brick((0, 0), (30, 5), 0, 60, 0.5)
    comb = Comb(slab, pitch_mm=10, gap_mm=4, slot_mm=-10, lying=False)
    inside = distance(comb, [0, 0, 40], [5, 0, 40], [10, 0, 40], [0, 0, 15], [29, 0, 40])
    np.testing.assert_allclose(inside, [2, -3, 2, -5, -1], atol=1e-5)
    brush = Brush(Brick((0, 0), (21, 11), 0, 20, 1), bristle_mm=2, pitch_mm=8, top_mm=60)
    np.testing.assert_allclose(distance(brush, [0, 0, 50], [8, 8, 50], [4, 0, 50]), [-2, -2, 2], atol=1e-5)


@pytest.mark.parametrize("family", SHAPES)
def test_no_distance_grows_faster_than_its_point_moves(family):
    for seed in range(4):
        shape, rng = draw(family, seed), np.random.default_rng([seed, 1])
        size = shape.upper - shape.lower
        p = rng.uniform(shape.lower - 0.4 * size, shape.upper + 0.4 * size, (4000, 3))
        q = p + rng.standard_normal((4000, 3)) * np.exp(rng.uniform(np.log(0.05), np.log(60), (4000, 1)))
        change, moved = np.abs(shape.distance(p) - shape.distance(q)), np.linalg.norm(p - q, axis=1)
        # float32 coordinates of about 200 mm have errors of 2e-5 mm, and a distance sums a few of them.
        assert (change <= moved * (1 + 1e-4) + 3e-4).all(), (seed, (change - moved).max())


@pytest.mark.parametrize("family", SHAPES)
def test_a_shape_stands_on_the_table_within_its_bounds(family):
    for seed in range(4):
        shape, rng = draw(family, seed), np.random.default_rng([seed, 2])
        size = shape.upper - shape.lower
        p = rng.uniform(shape.lower - 0.3 * size, shape.upper + 0.3 * size, (5000, 3))
        found = shape.distance(p)
        outside = ((p < shape.lower) | (p > shape.upper)).any(axis=1)
        assert (found[outside] > -1e-3).all()
        assert (found[~outside] < 0).any()
        foot = rng.uniform(shape.lower, shape.upper, (5000, 3)) * [1, 1, 0] + [0, 0, 0.3]
        assert (shape.distance(foot) < 0).any()


@pytest.mark.parametrize("family", SHAPES)
def test_sizes_fit_the_gripper_and_the_table(family):
    for seed in range(60):
        shape = draw(family, seed)
        width, depth, height = shape.upper - shape.lower
        relief = 2 * shape.relief_limit_mm
        assert shape.relief_limit_mm >= 0.1
        assert min(width, depth) >= 8
        assert min(width, depth) + relief <= 95 + 1e-9
        assert max(width, depth) <= 112
        assert 25 <= height <= 200


def test_chart_rays_meet_their_coordinates():
    s, t = np.meshgrid(np.linspace(1, 100, 30), np.linspace(5, 45, 9))
    twisted = Extrusion(Polygon(4, 18, 4), 50, twist_rad=1.0, taper=0.3)
    for chart in (CylindricalChart(20, 50), twisted.chart, TwoSidedChart(30, 50, 8)):
        origins, directions = chart.rays(s.ravel(), t.ravel())
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
        found = chart.locate(*np.ascontiguousarray((origins + 0.5 * directions).T, np.float32))
        np.testing.assert_allclose(found, [s.ravel(), t.ravel()], atol=1e-3)


def test_maps_run_to_the_right_in_a_front_view():
    x, y, z = np.array([[-3, 3], [-20, -20], [10, 10]], np.float32)
    for chart in (
        CylindricalChart(20, 50),
        Extrusion(RoundedRectangle(30, 20, 5), 50).chart,
        TwoSidedChart(30, 50, 20),
    ):
        left, right = chart.locate(x, y, z)[0]
        assert 5 < right - left < 7


def test_a_thread_climbs_one_pitch_in_a_turn():
    rod = ThreadedRod(10, 80, pitch_mm=6, depth_mm=2, starts=1, foot=Drum(15, 0, 8))
    around = rod.chart.width_mm
    t = np.linspace(20, 60, 400)
    height = rod.wall_pattern(np.array([0, 0.25 * around]), t)
    np.testing.assert_allclose(rod.wall_pattern(np.array([0.0]), t + 6)[:, 0], height[:, 0], atol=1e-5)
    np.testing.assert_allclose(rod.wall_pattern(np.array([0.0]), t - 1.5)[:, 0], height[:, 1], atol=1e-5)
    assert height.min() == pytest.approx(-2)
    assert height.max() == pytest.approx(0)


def test_the_polynomial_arctangent_is_an_arctangent():
    rng = np.random.default_rng(0)
    x, y = np.concatenate([rng.standard_normal((2, 5000)), [[0, 0, 0, 1, -1, 1e-20], [0, 1, -1, 0, 0, 1e-20]]], axis=1)
    x, y = x.astype(np.float32), y.astype(np.float32)
    # 1e-6 rad is 5e-5 mm on the widest object.
    np.testing.assert_allclose(arctan2(y, x), np.arctan2(y, x, dtype=float), atol=1e-6)
