"""Casting and normals against closed forms and a slow march that misses nothing; the contract of every body."""

import numpy as np
import pytest

from robot.sim.objects.body import SdfBody
from robot.sim.objects.draw import draw_object
from robot.sim.objects.relief import Relief
from robot.sim.objects.shapes import SHAPES
from robot.sim.objects.shapes.extrusion import Extrusion, RoundedRectangle
from robot.sim.objects.shapes.revolution import Ball, Drum, Revolution

SMOOTH = Relief("smooth", 0.0, 5.0)
ATOL = 2e-3  # mm; float32 coordinates and two secants


def ball(radius=25.0):
    return SdfBody(Revolution((Ball(radius, radius),), 2 * radius), SMOOTH)


def can(relief=SMOOTH, radius=20.0, height=80.0):
    return SdfBody(Revolution((Drum(radius, 0, height),), height), relief)


def box(relief=SMOOTH):
    return SdfBody(Extrusion(RoundedRectangle(40, 20, 2), 100, rim_mm=1), relief)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def random_rays(body, count, seed=0, level=False):
    """Return rays from far away to places in the bounding box."""
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((count, 3)) * ([1, 1, 0] if level else [1, 1, 1])
    directions = unit(directions)
    return rng.uniform(body.lower, body.upper, (count, 3)) - 400 * directions, directions


def wall_rays(body, rows=24, columns=32, z=40.0, pitch=0.5):
    """Return parallel rays from the front."""
    x, up = np.meshgrid((np.arange(columns) - columns / 2) * pitch, z + (np.arange(rows) - rows / 2) * pitch)
    origins = np.stack([x, np.full_like(x, body.lower[1] - 7.3), up], axis=-1).reshape(-1, 3)
    return origins, np.broadcast_to([0.0, 1.0, 0.0], origins.shape)


def test_rays_meet_a_sphere_at_the_root_of_the_quadratic():
    body = ball()
    origins, directions = random_rays(body, 3000)
    offset = origins - [0, 0, 25]
    half = np.einsum("ij,ij->i", offset, directions)
    root = half**2 - np.einsum("ij,ij->i", offset, offset) + 25**2
    exact = np.where(root > 0, -half - np.sqrt(np.maximum(root, 0)), np.inf)
    clear = np.abs(root) > 1  # a ray that grazes within 0.02 mm may go either way
    np.testing.assert_allclose(body.cast(origins, directions)[clear], exact[clear], atol=ATOL)


def test_rays_meet_the_side_of_a_cylinder_and_the_face_of_a_box():
    body = can()
    origins, directions = wall_rays(body, pitch=0.7)
    inside = np.abs(origins[:, 0]) < 20
    exact = -np.sqrt(400 - origins[inside, 0] ** 2) - origins[inside, 1]
    np.testing.assert_allclose(body.cast(origins, directions)[inside], exact, atol=ATOL)
    origins, directions = wall_rays(box())
    np.testing.assert_allclose(box().cast(origins, directions), -20 - origins[:, 1], atol=ATOL)


@pytest.mark.parametrize("relief", [SMOOTH, Relief("ribs", 1.0, 5.0)])
def test_a_ray_hits_where_its_distance_is_finite_and_at_once_if_it_starts_inside(relief):
    body = can(relief)
    origins, directions = wall_rays(body, pitch=2.0)
    found = body.hit(origins, directions)
    np.testing.assert_array_equal(found, np.isfinite(body.cast(origins, directions)))
    assert 0.1 < found.mean() < 1
    np.testing.assert_array_equal(body.cast(np.array([[0.0, 0, 40], [5, 5, 20]]), directions[:2]), 0)


def test_normals_of_a_sphere_a_cylinder_and_a_box():
    rng = np.random.default_rng(1)
    out = unit(rng.standard_normal((500, 3)))
    out = out[out[:, 2] > -0.9]
    np.testing.assert_allclose(ball().normals(25 * out + [0, 0, 25]), out, atol=2e-3)
    angle = rng.uniform(0, 2 * np.pi, 200)
    flat = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    np.testing.assert_allclose(can().normals(20 * flat + [0, 0, 40]), flat, atol=2e-3)
    np.testing.assert_allclose(
        box().normals(np.array([[5.0, -20, 50], [-40, 3, 60]])), [[0, -1, 0], [-1, 0, 0]], atol=2e-3
    )


def test_ribs_on_a_flat_wall_have_the_height_and_slope_of_a_cosine():
    """The gain at sharpness 0 is 0.4: h = 0.5 + tanh(0.4 cos) / (2 tanh 0.4)."""
    body = box(Relief("ribs", 0.8, 8.0, angle_rad=np.pi / 2, sharpness=0.0))
    origins, directions = wall_rays(body, rows=60, z=50.0, pitch=0.25)
    depth = body.cast(origins, directions)
    wave = np.cos(2 * np.pi * origins[:, 2] / 8.0)
    height = 0.8 * (0.5 + np.tanh(0.4 * wave) / (2 * np.tanh(0.4)))
    # Bilinear pixels of 0.2 mm cut an arch of curvature 0.25 / mm by 0.2^2 / 8 * 0.25 = 0.001 mm.
    np.testing.assert_allclose(-20 - origins[:, 1] - depth, height, atol=5e-3)
    normals = body.normals(origins + depth[:, None] * directions)
    per_wave = 0.8 * 0.4 / np.cosh(0.4 * wave) ** 2 / (2 * np.tanh(0.4))
    slope = -per_wave * np.sin(2 * np.pi * origins[:, 2] / 8) * 2 * np.pi / 8
    np.testing.assert_allclose(normals[:, 2] / -normals[:, 1], -slope, atol=0.03)


def slow_first_hits(body, origins, directions, step=0.02):
    """March every ray in small equal steps through the whole bounding box."""
    found = np.full(len(origins), np.inf)
    for number, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        reach = np.linalg.norm(body.upper - body.lower)
        middle = (body.lower + body.upper) / 2 - origin
        t = max(middle @ direction - reach, 0) + np.arange(0, 2 * reach, step)
        points = origin + t[:, None] * direction
        inside = ((points >= body.lower) & (points <= body.upper)).all(axis=1)
        if inside.any():
            below = np.flatnonzero(body.field(*np.ascontiguousarray(points[inside].T, np.float32)) <= 0)
            found[number] = t[inside][below[0]] if len(below) else np.inf
    return found


def test_large_steps_miss_thin_ribs_and_ours_do_not():
    """Rays that graze the wall at 2 degrees meet ribs 1 mm wide from the side."""
    body = box(Relief("ribs", 1.0, 2.0, angle_rad=0.0, sharpness=1.0))
    angle = np.radians(2)
    directions = np.tile([np.cos(angle), np.sin(angle), 0], (80, 1))
    targets = np.stack([np.linspace(-25, 10, 80), np.full(80, -20.6), np.full(80, 50.0)], axis=1)
    origins = targets - 120 * directions
    exact = slow_first_hits(body, origins, directions)
    naive = slow_first_hits(body, origins, directions, step=2.5)
    assert np.mean(naive > exact + 0.5) > 0.3
    found = body.cast(origins, directions)
    assert np.mean(np.abs(found - exact) < 0.1) > 0.97
    assert not np.isinf(found).any()


@pytest.mark.parametrize("index", range(6))
def test_casting_agrees_with_a_slow_march(index):
    body = draw_object(3, index).body
    origins, directions = random_rays(body, 60, seed=index, level=index % 2 == 0)
    exact, found = slow_first_hits(body, origins, directions), body.cast(origins, directions)
    hit = np.isfinite(exact) & np.isfinite(found)
    agree = np.isinf(exact) & np.isinf(found)
    agree[hit] = np.abs(exact[hit] - found[hit]) < 0.05
    # A ray that grazes a crest by less than the stride of 0.05 mm may miss it.
    assert agree.mean() >= 0.98


@pytest.mark.parametrize("family", SHAPES)
@pytest.mark.parametrize("relief", ["knurl", "glyphs"])
def test_rays_meet_every_family_on_its_surface_within_its_bounds(family, relief):
    body = draw_object(1, 7, family=family, relief=relief).body
    origins, directions = random_rays(body, 1200)
    t = body.cast(origins, directions)
    assert not np.isnan(t).any()
    assert np.isfinite(t).mean() > 0.1
    points = (origins + np.where(np.isfinite(t), t, 0)[:, None] * directions)[np.isfinite(t)]
    assert (points >= body.lower - 1e-3).all()
    assert (points <= body.upper + 1e-3).all()
    inner = ((points > body.lower + 0.05) & (points < body.upper - 0.05)).all(axis=1)
    # Not on the box's faces: a ray that enters through one may start on the surface. Inside a corner, behind a
    # bracket's web, relief of two sides may meet in a step, where f jumps over 0.
    assert np.mean(np.abs(body.field(*np.float32(points[inner].T))) < 0.02) > 0.995
    normals = body.normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    facing = np.einsum("ij,ij->i", normals, directions[np.isfinite(t)])
    assert np.mean(facing < 0.1) > 0.98


def test_relief_fades_before_the_edges():
    """The foot and the lid of a ribbed can are as round as those of a smooth one."""
    body, smooth = can(Relief("ribs", 2.0, 9.0, angle_rad=0.0)), can()
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    directions = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    for z in (0.1, 79.9):
        origins = -60 * directions + [0, 0, z]
        np.testing.assert_allclose(body.cast(origins, directions), smooth.cast(origins, directions), atol=0.02)
    middle = body.cast(-60 * directions + [0, 0, 40], directions)
    assert np.ptp(middle) > 1.5
