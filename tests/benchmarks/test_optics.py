"""Optics fitted to presses: measures, reading, surfaces, least squares, alignment, testing; drawn and real presses."""

import json
import math
from dataclasses import replace
from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from _touch_retrieval.documents import typed
from benchmarks.optics import least_squares as pose_fit
from benchmarks.optics import model_choice as press_model
from benchmarks.optics import photometric
from benchmarks.optics.image_error import compare, ssim
from benchmarks.optics.least_squares import OpticsSetting, aligned, columns_of, features, gram, labelled_poses, solve
from benchmarks.optics.model_choice import fit, held_out_error, picture_error, select, to_optics
from benchmarks.optics.real_presses import PIXEL_MM, Presses, ball_table, find_presses, read_presses
from robot.errors import BadRobotInput
from robot.sim.gel.fitted_optics import FITTED, FittedOptics, fitted_document, load_fitted
from robot.sim.gel.surface import Field, Surface

real = pytest.mark.skipif(find_spec("taxim") is None, reason="real presses come with taxim: pip install .[calibration]")
PLAIN = OpticsSetting(degree=2, places=3, reaches_mm=())


def draw_presses(count=6, seed=0, setting=PLAIN, noise=1.0):
    """Draw presses whose colours follow a known model of `setting`, in a picture of 260 x 320; labels are exact."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-1, 1, 320), np.linspace(-1, 1, 260))
    flat = np.stack([120 + 20 * x, 110 - 10 * y, 100 + 10 * x * y], axis=-1)
    centres = np.column_stack([rng.uniform(110, 210, count), rng.uniform(105, 155, count)])
    radii = rng.uniform(50, 62, count)
    no_contact = np.clip(np.rint(flat + rng.normal(0, noise, flat.shape)), 0, 255).astype(np.uint8)
    drawn = Presses("gelsight", no_contact, np.repeat(no_contact[None], count, axis=0), centres, radii)
    weights = rng.normal(0, 12, (features(drawn, 0, labelled_poses(drawn, setting)[0], setting).shape[1], 3))
    for index, pose in enumerate(labelled_poses(drawn, setting)):
        rows, cols = drawn.crop(index)
        change = np.reshape(features(drawn, index, pose, setting, 1) @ weights, (200, 200, 3))
        pressed = flat[rows, cols] + change + rng.normal(0, noise, change.shape)
        drawn.pictures[index][rows, cols] = np.clip(np.rint(pressed), 0, 255)
    return drawn, weights


# Measures --------------------------------------------------------------------------------------------------


def ssim_by_two_loops(a, b):
    reach = np.arange(-5, 6)
    window = np.exp(-(reach[:, None] ** 2 + reach**2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for channel in range(a.shape[2]):
        for row in range(5, a.shape[0] - 5):
            for col in range(5, a.shape[1] - 5):
                one = a[row - 5 : row + 6, col - 5 : col + 6, channel].astype(float)
                two = b[row - 5 : row + 6, col - 5 : col + 6, channel].astype(float)
                mean_1, mean_2 = (window * one).sum(), (window * two).sum()
                var_1, var_2 = (window * (one - mean_1) ** 2).sum(), (window * (two - mean_2) ** 2).sum()
                covariance = (window * (one - mean_1) * (two - mean_2)).sum()
                top = (2 * mean_1 * mean_2 + 2.55**2) * (2 * covariance + 7.65**2)
                values.append(top / ((mean_1**2 + mean_2**2 + 2.55**2) * (var_1 + var_2 + 7.65**2)))
    return np.mean(values)


def test_similarity_is_that_of_two_plain_loops():
    rng = np.random.default_rng(0)
    a = rng.integers(0, 256, (15, 17, 3), dtype=np.uint8)
    b = np.clip(a + rng.normal(0, 30, a.shape), 0, 255).astype(np.uint8)
    assert ssim(a, b) == pytest.approx(ssim_by_two_loops(a, b), abs=1e-9)
    assert ssim(a, a) == pytest.approx(1)


def test_errors_are_measured_on_rounded_and_clipped_pictures():
    truth = np.full((11, 11, 3), 250, np.uint8)
    errors = compare(np.full((11, 11, 3), 300.0), truth)
    assert (errors.l1, errors.mse) == (5, 25)
    assert errors.psnr == pytest.approx(20 * math.log10(255 / 5))
    assert compare(np.full((11, 11, 3), 250.4), truth).psnr == math.inf
    with pytest.raises(BadRobotInput, match="one shape"):
        compare(np.zeros((11, 12, 3)), truth)
    with pytest.raises(BadRobotInput, match="11 x 11"):
        compare(np.zeros((5, 5, 3)), np.zeros((5, 5, 3), np.uint8))


# Reading ---------------------------------------------------------------------------------------------------


def write(folder, **changes):
    drawn, _ = draw_presses(2)
    arrays = {
        "f0": drawn.no_contact,
        "imgs": drawn.pictures,
        "touch_center": drawn.centres,
        "touch_radius": drawn.radii,
    }
    (folder / "gelsight").mkdir(parents=True, exist_ok=True)
    given_arrays = {key: value for key, value in {**arrays, **changes}.items() if value is not None}
    np.savez(folder / "gelsight" / "dataPack.npz", **given_arrays)
    return folder


@pytest.mark.parametrize(
    "changes",
    [
        {"imgs": None},
        {"imgs": np.zeros((2, 10, 10, 3), np.uint8)},
        {"imgs": np.zeros((2, 260, 320, 3))},
        {"touch_center": np.zeros((5, 2))},
        {"touch_radius": np.array([55.0, np.nan])},
        {"touch_radius": np.array([{"a": 1}, None], dtype=object)},
    ],
)
def test_an_invalid_file_of_presses_is_refused_and_nothing_is_unpickled(tmp_path, changes):
    with pytest.raises(BadRobotInput, match=r"dataPack\.npz must hold"):
        read_presses(write(tmp_path, **changes), "gelsight")


# Surfaces --------------------------------------------------------------------------------------------------


def test_the_gel_follows_the_ball_in_the_contact_and_falls_off_outside():
    table = ball_table(2.0, 4.0, 0.48, (0.5,))
    x = np.linspace(0.01, 7.9, 400)
    (height, slope, across), (smooth, *_) = table.at(1.5, x, np.zeros(400))
    inside = x < 1.3
    cap = 2 - np.sqrt(4 - x[inside] ** 2)
    np.testing.assert_allclose(height[0] - height[inside], cap - cap[0], atol=0.01)
    np.testing.assert_allclose(slope[inside], -x[inside] / np.sqrt(4 - x[inside] ** 2), rtol=1e-9)
    assert not across.any()
    assert np.abs(height[x > 6]).max() < 0.1
    assert smooth[0] < height[0]
    outside = x > 1.7
    np.testing.assert_allclose(slope[outside], np.gradient(height, x)[outside], atol=0.02)


# Least squares ---------------------------------------------------------------------------------------------


def test_weights_without_ridge_are_those_of_least_squares_and_empty_columns_get_none():
    drawn, weights = draw_presses(4, noise=0.0)
    poses = labelled_poses(drawn, PLAIN)
    found = solve([gram(drawn, index, poses[index], PLAIN) for index in range(4)], 0.0)
    rows = np.concatenate([features(drawn, index, poses[index], PLAIN) for index in range(4)])
    target = np.concatenate([pose_fit.change(drawn, index) for index in range(4)])
    np.testing.assert_allclose(found, np.linalg.lstsq(rows, target, rcond=None)[0], atol=1e-6)
    np.testing.assert_allclose(rows @ found, rows @ weights, atol=0.2)  # pictures are rounded
    empty = pose_fit.Gram(np.diag([1.0, 0.0]), np.array([[2.0] * 3, [0.0] * 3]), 1.0, 3)
    np.testing.assert_allclose(solve([empty], 1e-9), [[2.0] * 3, [0.0] * 3], rtol=1e-6)


@pytest.mark.parametrize("narrow", [OpticsSetting(2, 3, reaches_mm=()), OpticsSetting(3, 1), OpticsSetting(1, 6)])
def test_a_narrow_model_is_some_columns_of_a_wide_one(narrow):
    drawn, _ = draw_presses(1)
    wide, pose = OpticsSetting(4, 6), labelled_poses(drawn, PLAIN)[0]
    whole, part = features(drawn, 0, pose, wide), features(drawn, 0, pose, narrow)
    np.testing.assert_array_equal(whole[:, columns_of(wide, narrow)], part)


def test_a_press_is_found_again_from_its_picture():
    drawn, weights = draw_presses(2)
    truth = labelled_poses(drawn, PLAIN)
    for index in range(2):
        start = truth[index] + [9, -7, -0.2]
        found = aligned(drawn, index, start, weights, PLAIN, 10)
        np.testing.assert_allclose(found, truth[index], atol=0.5)  # it started 9 px away


# Fitting and testing ---------------------------------------------------------------------------------------


def test_a_fit_predicts_held_out_presses_to_their_noise(monkeypatch):
    monkeypatch.setattr(press_model, "_THICKNESSES_MM", (4.0,))
    drawn, _ = draw_presses(9)
    setting = select(drawn, range(6), align=False)
    model = fit(drawn, range(6), setting, align=False)
    for index in range(6, 9):
        assert held_out_error(drawn, index, model).mse < 1.6  # noise 1 and rounding 1/12; that of f0 is blurred away
        assert picture_error(drawn, index, 0.0).mse > 20


@pytest.mark.slow
def test_held_out_pictures_do_not_affect_the_fit(monkeypatch):
    monkeypatch.setattr(press_model, "_THICKNESSES_MM", (4.0,))
    drawn, _ = draw_presses(6)
    other = replace(drawn, pictures=drawn.pictures.copy())
    other.pictures[4:] = 255 - other.pictures[4:]
    for align in (False, True):
        settings = [select(one, range(4), align=align, ship=True) for one in (drawn, other)]
        assert settings[0] == settings[1]
        models = [fit(one, range(4), settings[0], align=align) for one in (drawn, other)]
        np.testing.assert_array_equal(models[0].weights, models[1].weights)
        assert models[0].blur_px == models[1].blur_px


def test_the_optics_of_a_fit_render_its_predictions():
    setting = OpticsSetting(2, 3, reaches_mm=(0.6,))
    drawn, _ = draw_presses(4, setting=setting)
    model = fit(drawn, range(4), setting, align=False)
    field = Field(260, 320, PIXEL_MM)
    x, y = field.positions()
    centre, contact = (160.0, 130.0), float(np.median(model.poses[:, 2]))
    (height, *_), *_ = setting.table().at(
        contact, x - (centre[0] - 159.5) * PIXEL_MM, y - (centre[1] - 129.5) * PIXEL_MM
    )
    at_centre = replace(drawn, centres=np.tile(centre, (4, 1)))
    expected = np.reshape(
        features(at_centre, 0, np.array([*centre, contact]), setting, 1) @ model.weights, (200, 200, 3)
    )
    optics = to_optics(drawn, model)
    surface = Surface(height, field)
    change = optics.colours(surface, surface.slopes) - optics.backdrop(field)
    rows, cols = at_centre.crop(0)
    radius = np.hypot(*np.broadcast_arrays(np.arange(200) - 100, (np.arange(200) - 100)[:, None])) * PIXEL_MM
    # At the rim the map's differences smooth the kink; far out the border of the picture affects the smoothing.
    away_from_rim = (np.abs(radius - contact) > 0.15) & (radius < 2.3)
    assert np.abs(expected).max() > 10
    np.testing.assert_allclose(change[rows, cols][away_from_rim], expected[away_from_rim], atol=1.5)


@pytest.mark.slow
def test_the_command_fits_scores_and_writes_a_file_that_loads(tmp_path, monkeypatch, capsys):
    drawn, _ = draw_presses(5)
    arrays = {
        "f0": drawn.no_contact,
        "imgs": drawn.pictures,
        "touch_center": drawn.centres,
        "touch_radius": drawn.radii,
    }
    data = write(tmp_path / "data", **arrays)
    monkeypatch.setattr(press_model, "_THICKNESSES_MM", (4.0,))
    monkeypatch.setattr(photometric, "FIT_COUNT", {"gelsight": 4})
    monkeypatch.setattr(photometric, "SPLITS", 1)
    monkeypatch.setattr(photometric, "DEGREES", (2,))
    monkeypatch.setattr(press_model, "candidates", lambda wide, careful=False: [replace(wide, degree=2)])
    command = ["--data", str(data), "--sensor", "gelsight", "--out"]
    assert photometric.main([*command, str(tmp_path / "out")]) == 0
    output = capsys.readouterr().out
    assert "background only" in output
    content = json.loads((tmp_path / "out" / "gelsight.json").read_text())
    assert typed(content["model"], FittedOptics, "model").weights
    assert content["held_out"]["labels"]["mse"]["mean"] < 3


# Real presses ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def packs():
    return {name: read_presses(find_presses(), name) for name in FITTED}


def shipped_setting(name):
    values = fitted_document(name)["setting"]
    return OpticsSetting(**{**values, "reaches_mm": tuple(values["reaches_mm"])})


@pytest.mark.slow
@real
@pytest.mark.parametrize("name", FITTED)
def test_the_shipped_fit_is_reproducible_from_the_presses(name, packs):
    again = to_optics(packs[name], fit(packs[name], range(len(packs[name])), shipped_setting(name), align=True))
    field = Field(60, 80, 0.25)
    x, y = field.positions()
    surface = Surface(np.maximum(0, 0.6 - (x * x + y * y) / 16), field)
    colours = [one.colours(surface, surface.slopes) for one in (again, load_fitted(name))]
    np.testing.assert_allclose(*colours, atol=0.5)  # grey levels; another BLAS rounds differently


# Results of `python -m benchmarks.optics.photometric`, with some room: PSNR in dB and SSIM of held-out presses.
HELD_OUT = {"gelsight": (36.0, 0.974), "gelsight_mini": (33.0, 0.968)}


@real
@pytest.mark.parametrize("name", HELD_OUT)
def test_held_out_presses_are_predicted_better_than_before(name, packs):
    pack = packs[name]
    chosen, held_out = next(photometric.splits(len(pack), photometric.FIT_COUNT[name]))
    model = fit(pack, chosen, shipped_setting(name), align=True)
    errors = np.mean([held_out_error(pack, index, model) for index in held_out], axis=0)
    assert errors[3] > HELD_OUT[name][0] > 30.5
    assert errors[2] > HELD_OUT[name][1] > 0.966


@real
def test_labels_suffice_for_the_sensor_with_correct_labels(packs):
    pack = packs["gelsight"]
    chosen, held_out = next(photometric.splits(len(pack), 36))
    model = fit(pack, chosen, shipped_setting("gelsight"), align=False)
    errors = np.mean([held_out_error(pack, index, model) for index in held_out], axis=0)
    assert errors[3] > 34.0
    assert errors[2] > 0.970


@real
def test_the_first_channel_is_red_by_the_lamps(packs):
    """In this order, the lamps of the older sensor are red below left, green above left, blue right."""
    pack = packs["gelsight"]
    index = int(np.argmin(np.hypot(*(pack.centres - (320, 240)).T)))
    rows, cols = pack.crop(index)
    change = cv2.GaussianBlur(pack.pictures[index][rows, cols].astype(float) - pack.no_contact[rows, cols], (0, 0), 4)
    y, x = np.mgrid[-100:100, -100:100]
    inside = np.hypot(x, y) < 55
    towards = [np.array([(change[..., c] * axis)[inside].sum() for axis in (x, y)]) for c in range(3)]
    red, green, blue = (np.sign(np.where(np.abs(one) > 0.3 * np.abs(one).max(), one, 0)) for one in towards)
    assert red.tolist() == [-1, 1]
    assert green.tolist() == [-1, -1]
    assert blue.tolist() == [1, 0]
