"""Photo and depth agree with the geometry of the scene on the table."""

import dataclasses

import numpy as np
import pytest

from robot.sim import camera as cameras
from robot.sim.camera import Lighting, PinholeCamera, Placement, cast_camera_rays
from robot.sim.objects.draw import draw_object

POST = draw_object(0, 0, family="cylinder", relief="smooth")
HEIGHT_MM = float(POST.body.upper[2])
CAMERA = PinholeCamera()
LIGHT = Lighting.draw(np.random.default_rng(3))


def project(camera, point):
    """Pixel (x, y) of a point of the rig frame, by the pinhole equation."""
    local = np.linalg.inv(camera.to_rig) @ [*point, 1.0]
    return camera.focal_px * local[:2] / local[2] + (camera.px - 1) / 2


def test_the_object_appears_at_its_projected_position():
    view = cast_camera_rays(POST, Placement(30.0, -10.0, 0.4), CAMERA)
    middle = project(CAMERA, (30.0, -10.0, HEIGHT_MM / 2)).round().astype(int)
    mask = view.is_object.reshape(CAMERA.px, CAMERA.px)
    assert mask[middle[1], middle[0]]
    _, columns = np.nonzero(mask)
    assert columns.mean() == pytest.approx(middle[0], abs=2)
    above = project(CAMERA, (30.0, -10.0, HEIGHT_MM + 15)).round().astype(int)
    assert not mask[above[1], above[0]]


@pytest.mark.parametrize("index", range(2))
def test_casting_only_the_rays_near_the_object_gives_the_whole_object(index):
    obj, place = draw_object(0, index), Placement(12.0, -9.0, 0.3 + index)
    view, rays = cast_camera_rays(obj, place, CAMERA), CAMERA.rays
    origins = np.broadcast_to(place.to_object(np.array([CAMERA.position_mm])), rays.shape)
    every = obj.body.cast(origins, rays @ place.rotation(), view.detail_mm)
    table = -CAMERA.position_mm[2] / rays[:, 2]
    np.testing.assert_array_equal(view.is_object, every < table)
    np.testing.assert_allclose(view.distance_mm, np.minimum(every, table), rtol=1e-12)
    np.testing.assert_allclose(view.points, CAMERA.position_mm + view.distance_mm[:, None] * rays, atol=1e-9)


@pytest.mark.parametrize("index", range(2))
def test_casting_only_the_shadow_rays_near_the_object_gives_the_whole_shadow(index):
    obj, place = draw_object(0, index), Placement(12.0, -9.0, 0.3 + index)
    light = np.asarray(Lighting.draw(np.random.default_rng(index)).direction)
    view = cast_camera_rays(obj, place, CAMERA)
    near = cameras.shadow_pixels(view, light)
    table = np.flatnonzero(~view.is_object)
    starts = place.to_object(view.points[table] + [0, 0, 0.4])
    dark = table[obj.body.hit(starts, np.broadcast_to(light @ place.rotation(), starts.shape))]
    assert len(dark) > 50
    assert set(dark) <= set(near)
    assert len(near) < 0.7 * len(table)


def test_depth_has_holes_flying_pixels_and_whole_millimetres():
    view = cast_camera_rays(POST, Placement(), CAMERA)
    depth = cameras.depth(view, 1)
    assert depth.dtype == np.float32
    known = depth[np.isfinite(depth)] * 1000.0
    np.testing.assert_allclose(known, np.round(known), atol=1e-3)
    assert 0.001 < np.isnan(depth).mean() < 0.2
    exact = (view.distance_mm * (CAMERA.rays @ CAMERA.to_rig[:3, 2])).reshape(depth.shape)
    error_mm = np.abs(depth * 1000.0 - exact)
    assert np.nanmedian(error_mm) < 2
    assert np.nanmax(error_mm) > 10  # flying pixels between the object and its background


def test_the_shadow_darkens_the_table_on_the_side_away_from_the_lamp():
    lights = [dataclasses.replace(LIGHT, direction=(x, 0.0, 0.6)) for x in (0.8, -0.8)]
    view = cast_camera_rays(POST, Placement(), CAMERA)
    from_right, from_left = (cameras.photo(view, light, 1).astype(float) for light in lights)
    darker = (from_left - from_right).mean(axis=2).reshape(-1)
    rim_mm = float(POST.body.upper[0])
    table = ~view.is_object & (np.abs(view.points[:, 1]) < 5)
    behind = table & (view.points[:, 0] < -rim_mm - 3) & (view.points[:, 0] > -rim_mm - 10)
    before = table & (view.points[:, 0] > rim_mm + 3) & (view.points[:, 0] < rim_mm + 10)
    assert darker[behind].mean() > 20
    assert darker[before].mean() < -20


def test_relief_that_is_large_enough_for_the_pixels_shows():
    """Ribs shade the wall in rows or columns; a smooth wall of the same shape, colour and light has none."""
    ribbed, smooth = (draw_object(0, 0, family="cylinder", relief=relief) for relief in ("ribs", "smooth"))
    smooth = dataclasses.replace(smooth, appearance=ribbed.appearance, material=ribbed.material)
    roughness = []
    for obj in (ribbed, smooth):
        view = cast_camera_rays(obj, Placement(), CAMERA)
        photo = cameras.photo(view, LIGHT, 1).astype(float).mean(axis=2)
        mask = view.is_object.reshape(photo.shape)
        rows = slice(*np.quantile(np.nonzero(mask)[0], [0.4, 0.8]).astype(int))
        columns = slice(*np.quantile(np.nonzero(mask)[1], [0.3, 0.7]).astype(int))
        patch = photo[rows, columns]
        roughness.append(max(np.abs(np.diff(patch, 2, axis=axis)).mean() for axis in (0, 1)))
    assert roughness[0] > 1.5 * roughness[1]
