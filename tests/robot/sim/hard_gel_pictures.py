"""Stiff and extreme inputs of gel pictures and of the fit of their optics; see tests.robot.sim.hard_contact."""

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from benchmarks.optics.image_error import compare
from benchmarks.optics.least_squares import Gram, OpticsSetting, aligned, change, features, solve
from benchmarks.optics.real_presses import PIXEL_MM, BallTable, Presses
from robot.sim.contact.kernels import Floats
from robot.sim.contact.layer import Layer
from robot.sim.gel.sensor import GelSensor, Noise
from robot.sim.gel.surface import Field
from tests.hard_case import HardCase, error_of

_FIT, _GEL = "photometric fit", "gel picture"
_RIDGE = 1e-4


def hard_cases() -> Iterator[HardCase]:
    """Yield cases of pictures, in about two seconds."""
    yield _units_of_features()
    yield _feature_of_zeros()
    yield _equator()
    yield _press_without_information()
    yield _prediction_above_white()
    yield _lamp_too_bright()
    yield _nan_displacement()


def naive_ridge(columns: Floats, target: Floats) -> Floats:
    """Return weights (columns, 3) of (A'A + ridge) w = A'b, without scaling the columns."""
    normal = columns.T @ columns / len(columns) + _RIDGE * np.eye(columns.shape[1])
    return np.asarray(np.linalg.solve(normal, columns.T @ target / len(columns)))


def _grams(columns: Floats, target: Floats) -> list[Gram]:
    return [Gram(columns.T @ columns, columns.T @ target, float((target**2).sum()), target.size)]


def _columns() -> tuple[Floats, Floats]:
    """Return features (500, 4) of pixels, and the change of colour (500, 3) that weights of about 10 make of them."""
    rng = np.random.default_rng([21])
    columns = rng.normal(size=(500, 4))
    return columns, columns @ rng.normal(0, 10, (4, 3)) + rng.normal(size=(500, 3))


def _units_of_features() -> HardCase:
    """A slope of 1 and a displacement of 1e-6 m: the colours must not depend on the unit."""
    columns, target = _columns()
    scaled = columns * 10.0 ** np.array([-6, -2, 2, 6])
    expected = columns @ solve(_grams(columns, target), _RIDGE)
    weight_sets = naive_ridge(scaled, target), solve(_grams(scaled, target), _RIDGE)
    errors = [float(np.abs(scaled @ weights - expected).max()) for weights in weight_sets]
    naive, ours = (f"off by {error:.2g} grey levels" for error in errors)
    expected_text = "the same colours to 1e-6"
    return HardCase(
        _FIT, "features in units of 1e-6 to 1e6", expected_text, naive, ours, errors[1] < 1e-6, errors[0] < 1e-6
    )


def _feature_of_zeros() -> HardCase:
    """A feature that no press shows: plain least squares has no solution."""
    columns, target = _columns()
    columns[:, 2] = 0.0
    try:
        naive = np.linalg.solve(columns.T @ columns, columns.T @ target)
        words, naive_holds = f"weight {naive[2, 0]:.3g}", bool(naive[2, 0] == 0)
    except np.linalg.LinAlgError as error:
        words, naive_holds = str(error), False
    weights = solve(_grams(columns, target), 1e-12)
    holds = bool((weights[2] == 0).all() and np.isfinite(weights).all())
    return HardCase(_FIT, "a feature of zeros", "weight 0", words, f"weight {weights[2, 0]:g}", holds, naive_holds)


def _equator() -> HardCase:
    """A ball pressed to its equator has an infinite slope at the rim of the contact."""
    flat = np.zeros((2, 1, 1600))
    table = BallTable(2.0, np.array([1.0, 2.1]), flat, flat)
    rim = np.array([2.0])
    naive = float((rim / np.sqrt(table.ball_mm**2 - rim**2))[0])
    ours = float(-table.at(2.1, rim, np.zeros(1))[0][1][0])
    expected = "steep, but finite"
    return HardCase(
        _FIT, "slope at a ball's equator", expected, f"{naive}", f"{ours:g}", 5 < ours < math.inf, math.isfinite(naive)
    )


def naive_step(presses: Presses, pose: Floats, weights: Floats, setting: OpticsSetting) -> Floats:
    """Return a Gauss-Newton step (3,) of the pose on a picture, without damping. Raise LinAlgError if singular."""
    images = [features(presses, 0, pose + move, setting) @ weights for move in (*np.eye(3) * 0.02, np.zeros(3))]
    jacobian = np.stack([(one - images[3]).ravel() / 0.02 for one in images[:3]], axis=-1)
    error = (images[3] - change(presses, 0)).ravel()
    return np.asarray(np.linalg.solve(jacobian.T @ jacobian, -jacobian.T @ error))


def _press_without_information() -> HardCase:
    """Colours that do not depend on the pose make Gauss-Newton's equations singular."""
    gel = np.full((200, 200, 3), 100, np.uint8)
    presses = Presses("gelsight", gel, gel[None].copy(), np.array([[100.0, 100.0]]))
    setting = OpticsSetting(degree=1, places=1, reaches_mm=())
    start = np.array([100.0, 100.0, 40 * PIXEL_MM])
    weights = np.zeros((features(presses, 0, start, setting).shape[1], 3))
    try:
        step = float(np.abs(naive_step(presses, start, weights, setting)).max())
        words, naive_holds = f"moved by {step:g}", step == 0
    except np.linalg.LinAlgError as error:
        words, naive_holds = str(error), False
    moved = float(np.abs(aligned(presses, 0, start, weights, setting, 3) - start).max())
    case, expected = "a press without information", "the pose does not move"
    return HardCase(_FIT, case, expected, words, f"moved by {moved:g}", moved == 0, naive_holds)


def _prediction_above_white() -> HardCase:
    """A prediction of 300 on a pixel of 250 appears as 255: 5 grey levels off."""
    truth, predicted = np.full((11, 11, 3), 250, np.uint8), np.full((11, 11, 3), 300.0)
    naive = float(np.abs(predicted.astype(np.int64).astype(np.uint8).astype(float) - truth).mean())
    ours = compare(predicted, truth).l1
    words, ours_text = f"off by {naive:g}: 300 wraps to 44", f"off by {ours:g}"
    return HardCase(_FIT, "a prediction of 300 for 250", "off by 5", words, ours_text, ours == 5, naive == 5)


def _lamp_too_bright() -> HardCase:
    """Three times the exposure: values above 255 are white."""
    sensor = GelSensor(Layer(0.3, 0.48, 2.0), exposure=3.0, noise=Noise(0.0, 0.0), field=Field(24, 32))
    plain = GelSensor(Layer(0.3, 0.48, 2.0), noise=Noise(0.0, 0.0), field=Field(24, 32)).background(0).astype(np.int64)
    bright = plain * 3 > 258
    naive, ours = int((plain * 3).astype(np.uint8)[bright].min()), int(sensor.background(0)[bright].min())
    return HardCase(
        _GEL, "exposure x 3", "255 where overexposed", f"down to {naive}", f"{ours}", ours == 255, naive == 255
    )


def _nan_displacement() -> HardCase:
    displacement = np.zeros((24, 32))
    displacement[12, 16] = np.nan
    sensor = GelSensor(Layer(0.3, 0.48, 2.0), field=Field(24, 32))
    naive = int((~np.isfinite(np.gradient(displacement, axis=1))).sum())
    ours, holds = error_of(partial(sensor.render, displacement, 0), "finite")
    words = f"{naive} slopes along x are NaN"
    return HardCase(_GEL, "one displacement is NaN", "refused", words, ours, holds, naive == 0)
