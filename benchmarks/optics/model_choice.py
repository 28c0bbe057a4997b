"""Fit the optics of one sensor to its presses; all choices use only the fitted presses.

Inner folds choose thickness of the layer, degree, places, reaches and ridge. The fitted presses themselves choose the
blur of the unpressed picture, which removes its noise.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.optics.image_error import PictureError, compare
from benchmarks.optics.least_squares import (
    Gram,
    Matrix,
    OpticsSetting,
    align_all,
    aligned,
    columns_of,
    features,
    first_pose,
    gram,
    solve,
)
from benchmarks.optics.real_presses import BALLS_MM, CROP, Presses
from robot.sim.gel.fitted_optics import FittedLimits, FittedOptics, place_powers

# The Mini was pressed only in the middle, and lightly. The effect of place, neighbourhood and fourth powers on its
# colours is unknown elsewhere and for other objects, where they would draw rings and false colours.
SHALLOW = ("gelsight_mini",)
# The Mini was pressed at three places, deeper each time: a random split holds out a depth, not a place.
SAME_PLACE = {"gelsight_mini": (range(13), range(13, 18), range(18, 24))}
ALIGNING = OpticsSetting(degree=3, places=3, reaches_mm=())  # small, so that colours cannot compensate for wrong poses
_ALIGN_STEPS = 10
_FLAT_DEGREE = 6
_WIDE = OpticsSetting(degree=4, places=6)
_BLURS_PX = (0.0, 1.0, 2.0, 4.0, 8.0)
_THICKNESSES_MM = (2.0, 4.0, 6.0)
_RIDGES = (1e-5, 1e-4, 1e-3, 1e-2)


def candidates(wide: OpticsSetting, *, careful: bool = False) -> Iterator[OpticsSetting]:
    """Yield the settings for one shape of the surface; `careful`: no degree 4, no places, no neighbourhood."""
    reaches = ((),) if careful else ((), wide.reaches_mm)
    degrees, places_known = ((2, 3), (1,)) if careful else ((2, 3, 4), (1, 3, 6))
    for degree, places, ridge, reach in itertools.product(degrees, places_known, _RIDGES, reaches):
        yield replace(wide, degree=degree, places=places, ridge=ridge, reaches_mm=reach)


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model.

    Attributes:
        setting: its setting.
        weights: its weights.
        poses: (count, 3) poses of the fitted presses.
        blur_px: blur of the unpressed picture.
    """

    setting: OpticsSetting
    weights: Matrix
    poses: Matrix
    blur_px: float = 0.0


def fit(presses: Presses, chosen: Sequence[int], setting: OpticsSetting) -> Fit:
    """Return the weights of one setting on the chosen presses, and the best blur for them."""
    poses = _poses(presses, chosen, setting)
    weights = solve([gram(presses, one, poses[one], setting) for one in chosen], setting.ridge)
    fitted = Fit(setting, weights, poses)
    changes = {one: _change(presses, one, poses[one], fitted) for one in chosen[::3]}
    losses = [
        (float(np.mean([picture_error(presses, one, change, blur).mse for one, change in changes.items()])), blur)
        for blur in _BLURS_PX
    ]
    return replace(fitted, blur_px=min(losses)[1])


def select(presses: Presses, chosen: Sequence[int]) -> OpticsSetting:
    """Return the setting with the least squared error over inner folds of the chosen presses.

    A fold is a place if presses share places, and the choice is careful if every press was shallow (see SHALLOW): the
    model must generalise to other places and objects, not only to these presses.
    """
    folds = _place_folds(presses, chosen)
    losses: list[tuple[float, OpticsSetting]] = []
    for thickness, ball in itertools.product(_THICKNESSES_MM, BALLS_MM[presses.name]):
        wide = replace(_WIDE, thickness_mm=thickness, ball_mm=ball)
        poses = _poses(presses, chosen, wide)
        grams = [gram(presses, one, poses[one], wide) for one in chosen]
        for setting in candidates(wide, careful=presses.name in SHALLOW):
            losses.append((_inner_loss(grams, folds, columns_of(wide, setting), setting.ridge), setting))
    return min(losses, key=lambda item: item[0])[1]


def _place_folds(presses: Presses, chosen: Sequence[int]) -> list[list[int]]:
    """Return the positions in `chosen` that are held out together: one place at a time, or every third."""
    groups: Sequence[Sequence[int]] = SAME_PLACE.get(presses.name) or [list(chosen)[first::3] for first in range(3)]
    folds = [[at for at, one in enumerate(chosen) if one in group] for group in groups]
    return [fold for fold in folds if fold]


def _poses(presses: Presses, chosen: Sequence[int], setting: OpticsSetting) -> Matrix:
    return align_all(presses, chosen, replace(ALIGNING, thickness_mm=setting.thickness_mm, ball_mm=setting.ball_mm))


def _change(presses: Presses, index: int, pose: Matrix, model: Fit) -> Matrix:
    """Return the change (200, 200, 3) that a model predicts for a press in this pose."""
    return np.reshape(features(presses, index, pose, model.setting, 1) @ model.weights, (CROP, CROP, 3))


def _inner_loss(
    grams: Sequence[Gram], folds: Sequence[Sequence[int]], columns: NDArray[np.intp], ridge: float
) -> float:
    parts = [one.part(columns) for one in grams]
    losses = []
    for fold in folds:
        weights = solve([one for at, one in enumerate(parts) if at not in fold], ridge)
        losses += [parts[at].loss(weights) for at in fold]
    return float(np.mean(losses))


def to_optics(presses: Presses, fitted: Fit) -> FittedOptics:
    """Return the fit as optics for a sensor, with the limits of its presses."""
    setting = fitted.setting
    flat = _tuples(flat_weights(presses.no_contact))
    weights, limits = _tuples(fitted.weights), _limits(presses, fitted)
    return FittedOptics(setting.degree, setting.places, setting.reaches_mm, weights, _FLAT_DEGREE, flat, limits)


def _limits(presses: Presses, fitted: Fit) -> FittedLimits:
    """Return tilts that half of the presses reached, the crops' places, and the ranges of the neighbourhoods."""
    smoothed = np.concatenate([_neighbourhood(presses, one, pose, fitted) for one, pose in enumerate(fitted.poses)])
    rows, cols = zip(*(presses.crop(index) for index in range(len(presses))), strict=True)
    height, width = presses.no_contact.shape[:2]
    return FittedLimits(
        steepest=float(np.median(fitted.poses[:, 2]) / fitted.setting.ball_mm),
        left=2 * min(one.start for one in cols) / width - 1,
        right=2 * max(one.stop for one in cols) / width - 1,
        top=2 * min(one.start for one in rows) / height - 1,
        bottom=2 * max(one.stop for one in rows) / height - 1,
        lowest=tuple(map(float, smoothed.min(axis=0))),
        highest=tuple(map(float, smoothed.max(axis=0))),
    )


def _neighbourhood(presses: Presses, index: int, pose: Matrix, fitted: Fit) -> Matrix:
    """Return the smoothed displacement of a press and its slopes, without the places: (pixels, 3 x reaches)."""
    count = 3 * len(fitted.setting.reaches_mm)
    plain = features(presses, index, pose, fitted.setting)[:, :: fitted.setting.places]
    return plain[:, plain.shape[1] - count :]


def flat_weights(no_contact: NDArray[np.uint8]) -> Matrix:
    """Fit the unpressed picture by a polynomial in x and y (-1 to 1), (terms, 3), by least squares."""
    height, width = no_contact.shape[:2]
    y, x = np.mgrid[0:height:4, 0:width:4]
    x, y = (2 * x.ravel() - width + 1) / width, (2 * y.ravel() - height + 1) / height
    terms = np.stack([x**i * y**j for i, j in place_powers(_FLAT_DEGREE)], axis=-1)
    return np.asarray(np.linalg.lstsq(terms, no_contact[::4, ::4].reshape(-1, 3).astype(np.float64), rcond=None)[0])


def _tuples(values: Matrix) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in values)


def held_out_error(presses: Presses, index: int, model: Fit) -> PictureError:
    """Return the error of a model on a press that it was not fitted to."""
    start = first_pose(presses, index, model.setting)
    pose = aligned(presses, index, start, model.weights, model.setting, _ALIGN_STEPS)
    return picture_error(presses, index, _change(presses, index, pose, model), model.blur_px)


def picture_error(presses: Presses, index: int, change: Any, blur_px: float = 0.0) -> PictureError:
    """Return the errors of unpressed picture + change on the crop of a press."""
    rows, cols = presses.crop(index)
    return compare(
        presses.smooth_no_contact(blur_px)[rows, cols] + np.asarray(change), presses.pictures[index][rows, cols]
    )
