"""Hand-eye calibration: known maps are recovered, errors equal those of plain loops, bad points raise."""

import json
import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot import devices
from robot.errors import RobotConfigError
from robot.sight import hand_eye
from robot.sight.hand_eye import fit_hand_eye, load_hand_eye, read_pairs

WRITTEN = datetime(2026, 3, 1, 12, tzinfo=UTC)


def cube(scale=100.0):
    """Return eight corners and the centre."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    return scale * np.vstack([corners, [[0.5, 0.5, 0.5]]])


def rotation(seed):
    found = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return found * np.sign(np.linalg.det(found))


def distorted(camera):
    """Return rig points for a camera with errors of 4 % in depth and 2 % in width, and 1 mm of noise."""
    stretched = camera * [1.02, 1.0, 0.96]
    noise = np.random.default_rng(0).normal(0, 1.0, camera.shape)
    return stretched @ rotation(1).T + [10.0, 20.0, 700.0] + noise


def test_a_quarter_turn_about_z():
    camera = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float) * 100
    rig = np.array([[5, 0, 0], [5, 100, 0], [-95, 0, 0], [5, 0, 100], [-95, 100, 100]], dtype=float)
    expected = [[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    found = fit_hand_eye(camera, rig)
    np.testing.assert_allclose(found.rigid, expected, rtol=0, atol=1e-12)  # rounding errors of numbers near 100
    np.testing.assert_allclose(found.affine, expected, rtol=0, atol=1e-12)


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.floats(-1e5, 1e5))
def test_a_known_rigid_map_is_recovered_with_any_origin(seed, far):
    rng = np.random.default_rng(seed)
    camera = rng.uniform(-300, 300, (12, 3)) + far
    turn, offset = rotation(seed), rng.uniform(-1000, 1000, 3)
    found = fit_hand_eye(camera, camera @ turn.T + offset)
    np.testing.assert_allclose(
        found.rigid[:3, :3], turn, rtol=0, atol=1e-9
    )  # coordinates of 1e5 mm have rounding errors of 1e-11
    assert found.rigid_errors.max_mm < 1e-6
    assert found.affine_errors.max_mm < 1e-6
    assert found.warning is None


def test_a_known_affine_map_is_recovered():
    linear = np.diag([1.02, 1.0, 0.9])
    found = fit_hand_eye(cube(), cube() @ linear.T + [1, 2, 3])
    np.testing.assert_allclose(found.affine[:3, :3], linear, rtol=0, atol=1e-12)
    assert found.rigid_errors.max_mm > 1


def test_mirrored_points_give_a_rotation_and_the_naive_formula_a_reflection():
    camera = cube()
    rig = camera * [1, 1, -1]
    left, _, right = np.linalg.svd((rig - rig.mean(0)).T @ (camera - camera.mean(0)))
    assert np.linalg.det(left @ right) == pytest.approx(-1)  # the naive formula
    found = fit_hand_eye(camera, rig)
    assert np.linalg.det(found.rigid[:3, :3]) == pytest.approx(1)
    assert found.rigid_errors.max_mm > 10


def test_the_rigid_map_is_a_valid_extrinsics_matrix():
    found = fit_hand_eye(cube(), distorted(cube()))
    np.testing.assert_array_equal(devices._check_rigid(found.rigid), found.rigid)


@pytest.mark.parametrize("kind", ["rigid", "affine"])
def test_errors_are_those_of_two_plain_loops(kind):
    camera, rig = cube(), distorted(cube())
    fit = {"rigid": hand_eye.fit_rigid, "affine": hand_eye.fit_affine}[kind]
    whole, own, left = fit(camera, rig), [], []
    for index in range(len(camera)):
        part = fit(np.delete(camera, index, 0), np.delete(rig, index, 0))
        for matrix, errors in ((whole, own), (part, left)):
            point = [
                sum(matrix[row][col] * camera[index][col] for col in range(3)) + matrix[row][3] for row in range(3)
            ]
            errors.append(math.dist(point, rig[index]))
    found = getattr(fit_hand_eye(camera, rig), f"{kind}_errors")
    expected = (sum(own) / len(own), max(own), sum(left) / len(left), max(left))
    np.testing.assert_allclose((found.mean_mm, found.max_mm, found.loo_mean_mm, found.loo_max_mm), expected, rtol=1e-9)
    assert found.loo_mean_mm > found.mean_mm


def test_a_camera_with_wrong_depth_fits_better_by_an_affine_map_and_gives_a_warning():
    """The authors' nine points are similar: affine 2.7 mm and 4.7 left out, rigid 8.7 and 10.2."""
    found = fit_hand_eye(3 * cube(), distorted(3 * cube()))
    assert found.affine_errors.mean_mm < 0.5 * found.rigid_errors.mean_mm
    assert found.affine_errors.loo_mean_mm < 0.6 * found.rigid_errors.loo_mean_mm
    assert "intrinsics or depth scale" in found.warning


def test_a_correct_camera_with_noise_gives_no_warning():
    """In sample the affine map always has the smaller error, but not for left-out points."""
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(0, 3.0, cube().shape)
        found = fit_hand_eye(3 * cube(), 3 * cube() @ rotation(seed).T + noise)
        squared = [np.square(_off(matrix, 3 * cube(), found.rig_mm)).sum() for matrix in (found.affine, found.rigid)]
        assert squared[0] <= squared[1]
        assert found.warning is None


def _off(matrix, camera, rig):
    return np.linalg.norm(hand_eye.apply_map(matrix, camera) - rig, axis=1)


def pairs(count, seed, noise_mm=3.0):
    """Return points of a rig of 300 mm as measured by a correct camera, 700 mm away, and in the rig's frame."""
    rng = np.random.default_rng(seed)
    chosen = [0, 3, 5, 6] if count == 4 else range(count)  # four corners that span the cube
    camera = 300 * cube(1.0)[chosen] + [-150.0, -150.0, 550.0]
    return camera, camera @ rotation(seed).T + [10.0, 20.0, 700.0] + rng.normal(0, noise_mm, camera.shape)


@pytest.mark.parametrize("count", [4, 5, 9])
@pytest.mark.parametrize("seed", range(5))
def test_metres_for_millimetres_are_named_for_any_number_of_points(count, seed):
    camera, rig = pairs(count, seed)
    assert fit_hand_eye(camera, rig).warning is None
    found = fit_hand_eye(camera / 1000, rig)
    assert found.rigid_errors.mean_mm > 100
    assert "the camera points seem to be in metres" in found.warning
    assert "the rig points seem to be in metres" in fit_hand_eye(camera, rig / 1000).warning
    assert "all points seem to be in metres" in fit_hand_eye(camera / 1000, rig / 1000).warning
    assert "mirrored" not in found.warning


@pytest.mark.parametrize("count", [4, 5, 9])
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("wrong", [[1, 1, -1], [1, -1, 1], [-1, -1, -1]])
def test_a_mirrored_axis_is_named_for_any_number_of_points(count, seed, wrong):
    camera, rig = pairs(count, seed)
    found = fit_hand_eye(camera * wrong, rig)
    assert found.rigid_errors.mean_mm > 20
    assert "one axis seems to be mirrored" in found.warning
    assert "metres" not in found.warning
    if found.affine is not None:
        assert np.linalg.det(found.affine[:3, :3]) < 0


@pytest.mark.parametrize("seed", range(5))
def test_a_mirrored_axis_is_named_for_points_with_a_small_extent_along_it(seed):
    """The depth is 60 mm with 5 mm of noise, and a mirrored axis costs about 20 mm."""
    camera, rig = pairs(9, seed, noise_mm=5.0)
    thin = camera * [1, 1, 0.2]
    rig = thin @ rotation(seed).T + (rig - camera @ rotation(seed).T)
    assert fit_hand_eye(thin, rig).warning is None
    assert "mirrored" in fit_hand_eye(thin * [1, 1, -1], rig).warning


def test_both_causes_at_once_and_swapped_axes_are_named():
    camera, rig = pairs(9, 0)
    both = fit_hand_eye(camera * [1e-3, 1e-3, -1e-3], rig).warning
    assert "metres" in both
    assert "mirrored" in both
    assert "or two swapped" in fit_hand_eye(camera[:, [1, 0, 2]], rig).warning


@pytest.mark.parametrize("count", [4, 9])
def test_wrong_pairs_are_named_if_nothing_else_explains_the_error(count):
    camera, rig = pairs(count, 0)
    swapped = rig.copy()
    swapped[[0, 3]] = rig[[3, 0]]
    found = fit_hand_eye(camera, swapped)
    assert found.rigid_errors.mean_mm > 20
    assert "paired with the wrong rig points" in found.warning


def test_a_large_leave_one_out_error_alone_gives_a_warning_too():
    """One point has an error of 90 mm."""
    camera, rig = pairs(9, 1, noise_mm=0.0)
    rig[8] += [0.0, 90.0, 0.0]
    found = fit_hand_eye(camera, rig)
    limit = (found.rigid_errors.mean_mm + found.rigid_errors.loo_mean_mm) / 2
    assert found.rigid_errors.mean_mm < limit < found.rigid_errors.loo_mean_mm
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hand_eye, "SUSPECT_MM", limit)
        assert "single points may be wrong" in found.warning
        patch.setattr(hand_eye, "SUSPECT_MM", 1.1 * found.rigid_errors.loo_mean_mm)
        assert found.warning is None


def test_coplanar_points_are_never_reported_as_mirrored():
    camera, rig = pairs(9, 2)
    camera[:, 2] = 700.0
    flat = camera @ rotation(2).T + np.random.default_rng(0).normal(0, 3.0, rig.shape)
    assert fit_hand_eye(camera * [1, 1, -1], flat).warning is None


LINE = [[t, 2 * t, 3 * t] for t in (0.0, 10.0, 20.0, 30.0, 40.0)]


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (cube()[:3], "at least 4 pairs"),
        (LINE, "one line"),
        ([*LINE[:4], [0.0, 0.0, 50.0]], "all but one"),
        ([[1.0, 1.0, 1.0]] * 6, "one line"),
        ([*cube()[:5], [math.nan, 0, 0]], "finite"),
        ([*cube()[:5], [math.inf, 0, 0]], "kilometre"),
        ([*cube()[:5], [1e300, 0, 0]], "kilometre"),
        (cube()[:, :2], r"\(N, 3\)"),
        ([["a", "b", "c"]], "rows of x, y and z"),
        ([[1.0, 2.0], [1.0]], "rows of x, y and z"),
    ],
)
def test_insufficient_points_are_refused(points, message):
    with pytest.raises(RobotConfigError, match=message):
        fit_hand_eye(points, points)


def test_collinear_rig_points_and_missing_points_are_refused():
    with pytest.raises(RobotConfigError, match="the rig points must not lie on one line"):
        fit_hand_eye(cube()[:5], LINE)
    with pytest.raises(RobotConfigError, match="each camera point must have a rig point, got 9 and 8"):
        fit_hand_eye(cube(), cube()[:8])


def test_coplanar_points_determine_the_rigid_map_but_no_affine_one():
    camera = cube() * [1, 1, 0] + [[0, 0, 0.1 * (index % 3)] for index in range(9)]
    found = fit_hand_eye(camera, camera @ rotation(3).T + [1, 2, 3])
    np.testing.assert_allclose(found.rigid[:3, :3], rotation(3), rtol=0, atol=1e-9)
    assert (found.affine, found.affine_errors, found.warning) == (None, None, None)
    assert "plane" in found.affine_problem
    four = fit_hand_eye(cube()[[0, 1, 2, 4]], cube()[[0, 1, 2, 4]])
    assert "at least 5" in four.affine_problem


def saved(tmp_path, **changes):
    found = fit_hand_eye(cube(), distorted(cube()), written=WRITTEN)
    path = tmp_path / "hand_eye.json"
    found.save(path)
    document = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in document.items() if value is not ...}))
    return path


def test_a_saved_calibration_is_read_back_exactly(tmp_path):
    found, read = fit_hand_eye(cube(), distorted(cube()), written=WRITTEN), load_hand_eye(saved(tmp_path), now=WRITTEN)
    for name in ("camera_mm", "rig_mm", "rigid", "affine"):
        np.testing.assert_array_equal(getattr(read, name), getattr(found, name))
    assert (read.rigid_errors, read.affine_errors, read.written) == (
        found.rigid_errors,
        found.affine_errors,
        found.written,
    )
    assert [path.name for path in tmp_path.iterdir()] == ["hand_eye.json"]


def test_an_old_calibration_is_refused_with_its_age(tmp_path):
    path = saved(tmp_path)
    assert (
        load_hand_eye(path, max_age_days=30, now=WRITTEN + timedelta(days=30)).age_days(WRITTEN + timedelta(days=3))
        == 3
    )
    with pytest.raises(RobotConfigError, match="at most 30 days old, got 31"):
        load_hand_eye(path, max_age_days=30, now=WRITTEN + timedelta(days=31))
    with pytest.raises(RobotConfigError, match="2 days in the future"):
        load_hand_eye(path, now=WRITTEN - timedelta(days=2))
    assert load_hand_eye(path, now=WRITTEN + timedelta(days=4000))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"note": 1}, "has no setting 'note'"),
        ({"version": 2}, "version 1"),
        ({"points": ...}, "not a hand-eye calibration"),
        ({"points": [{"camera_mm": [0, 0, 0]}]}, "not a hand-eye calibration"),
        ({"points": []}, "must be|at least"),
        ({"points": [{"camera_mm": [10**400, 0, 0], "rig_mm": [0, 0, 0]}]}, "points.camera_mm must fit into 64 bits"),
        ({"written": "yesterday"}, "not a hand-eye calibration"),
        ({"rigid": [[1]]}, "rigid must be a list of length"),
        ({"rigid": np.eye(4).tolist()}, "file was changed"),
        ({"rigid": "x"}, "not a hand-eye calibration"),
    ],
)
def test_a_changed_file_is_refused(tmp_path, changes, message):
    with pytest.raises(RobotConfigError, match=message):
        load_hand_eye(saved(tmp_path, **changes), now=WRITTEN)


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff\xfe", b"[" * 100_000, b"null"])
def test_a_file_that_is_not_a_calibration_is_refused(tmp_path, content):
    path = tmp_path / "x.json"
    path.write_bytes(content)
    with pytest.raises(RobotConfigError, match=r"x\.json"):
        load_hand_eye(path)
    with pytest.raises(RobotConfigError, match="cannot be read"):
        load_hand_eye(tmp_path / "none.json")


def csv_file(tmp_path, text):
    path = tmp_path / "pairs.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_pairs_are_read_from_columns_in_any_order(tmp_path):
    text = "\ufeffrig_x_mm,rig_y_mm,rig_z_mm,camera_z_mm,camera_y_mm,camera_x_mm\r\n1,2,3,4,5,6\r\n-1,0,1e2,0,0,.5\r\n"
    camera, rig = read_pairs(csv_file(tmp_path, text))
    np.testing.assert_array_equal(camera, [[6, 5, 4], [0.5, 0, 0]])
    np.testing.assert_array_equal(rig, [[1, 2, 3], [-1, 0, 100]])


HEAD = ",".join(hand_eye.COLUMNS) + "\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must have the columns camera_x_mm"),
        ("a,b\n1,2\n", "must have the columns"),
        (HEAD.strip() + ",note\n1,2,3,4,5,6,7\n", "must have the columns"),
        (HEAD + "1,2,3,4,5\n", "line 2: every column must contain a number"),
        (HEAD + "1,2,3,4,5,six\n", "line 2: every column"),
        (HEAD + "1,2,3,4,5,6,7\n", "line 2 must have 6 columns"),
        (b"\xff\xfe\x00", "not CSV text"),
    ],
)
def test_an_invalid_file_of_pairs_is_refused(tmp_path, text, message):
    with pytest.raises(RobotConfigError, match=message):
        read_pairs(csv_file(tmp_path, text))
    with pytest.raises(RobotConfigError, match="cannot be read"):
        read_pairs(tmp_path / "none.csv")
