"""Hand-eye calibration: known maps are recovered, residuals equal those of plain loops, bad points raise."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.errors import RobotConfigError
from robot.sight import hand_eye
from robot.sight.hand_eye import fit_hand_eye, load_hand_eye
from tests.robot.test_devices import Eye, picture


def cube(scale=100.0):
    """Return eight corners and the centre."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    return scale * np.vstack([corners, [[0.5, 0.5, 0.5]]])


def rotation(seed):
    found = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return found * np.sign(np.linalg.det(found))


def measured(camera, noise_mm=3.0):
    """Return the rig points of camera points, with noise."""
    return camera @ rotation(1).T + [10.0, 20.0, 700.0] + np.random.default_rng(0).normal(0, noise_mm, camera.shape)


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.floats(-1e5, 1e5))
def test_a_known_rigid_map_is_recovered_with_any_origin(seed, far):
    rng = np.random.default_rng(seed)
    camera = rng.uniform(-300, 300, (12, 3)) + far
    turn, offset = rotation(seed), rng.uniform(-1000, 1000, 3)
    found = fit_hand_eye(camera, camera @ turn.T + offset)
    np.testing.assert_allclose(found.rigid[:3, :3], turn, rtol=0, atol=1e-9)  # coordinates of 1e5 mm round to 1e-11
    assert found.residuals_mm.max() < 1e-6
    Eye(picture(), found.rigid)  # a camera accepts it


def test_mirrored_points_give_a_rotation_and_the_naive_formula_a_reflection():
    camera = cube()
    rig = camera * [1, 1, -1]
    left, _, right = np.linalg.svd((rig - rig.mean(0)).T @ (camera - camera.mean(0)))
    assert np.linalg.det(left @ right) == pytest.approx(-1)  # the naive formula
    found = fit_hand_eye(camera, rig)
    assert np.linalg.det(found.rigid[:3, :3]) == pytest.approx(1)
    assert found.residuals_mm.mean() > hand_eye.SUSPECT_MM


def test_residuals_are_those_of_two_plain_loops_and_points_of_one_plane_are_enough():
    flat = cube()[[0, 1, 2, 3]]
    np.testing.assert_allclose(fit_hand_eye(flat, measured(flat, 0.0)).rigid[:3, :3], rotation(1), rtol=0, atol=1e-9)
    camera, rig = cube(), measured(cube())
    found = fit_hand_eye(camera, rig)
    expected = []
    for point, target in zip(camera, rig, strict=True):
        mapped = [sum(row[axis] * point[axis] for axis in range(3)) + row[3] for row in found.rigid[:3]]
        expected.append(math.dist(mapped, target))
    np.testing.assert_allclose(found.residuals_mm, expected, rtol=1e-9)
    assert 0.5 < found.residuals_mm.mean() < 10


LINE = [[t, 2 * t, 3 * t] for t in (0.0, 10.0, 20.0, 30.0, 40.0)]


@pytest.mark.parametrize(
    ("camera", "rig", "message"),
    [
        (cube()[:8], cube(), "got .8, 3. and .9, 3."),
        (LINE, cube()[:5], "the camera points must not lie on one line"),
        (cube()[:5], LINE, "the rig points must not lie on one line"),
        ([*cube()[:5], [math.nan, 0, 0]], cube()[:6], "finite"),
        (cube()[:, :2], cube()[:, :2], "N x 3"),
    ],
)
def test_insufficient_points_are_refused(camera, rig, message):
    with pytest.raises(RobotConfigError, match=message):
        fit_hand_eye(camera, rig)


def saved(tmp_path, **changes):
    """Write a calibration with changed keys."""
    path = tmp_path / "hand_eye.json"
    fit_hand_eye(cube(), measured(cube())).save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return path


def test_a_saved_calibration_is_read_back_exactly(tmp_path):
    read = load_hand_eye(saved(tmp_path))
    np.testing.assert_array_equal(read, fit_hand_eye(cube(), measured(cube())).rigid)
    assert [path.name for path in tmp_path.iterdir()] == ["hand_eye.json"]


@pytest.mark.parametrize("content", [b"", b"[]", b'{"written": "yesterday"}', b"\xff\xfe"])
def test_a_file_that_is_not_a_calibration_is_refused(tmp_path, content):
    path = tmp_path / "x.json"
    path.write_bytes(content)
    with pytest.raises(RobotConfigError, match=r"x\.json"):
        load_hand_eye(path)
    with pytest.raises(RobotConfigError, match="not a hand-eye calibration"):
        load_hand_eye(saved(tmp_path, note=1))
    with pytest.raises(RobotConfigError, match="cannot be read"):
        load_hand_eye(tmp_path / "none.json")
