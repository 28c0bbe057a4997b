"""Least squares for the fitted optics: features of a press, weights by ridge regression, and the pose of a press.

A press has a pose: x, y of its middle (pixels) and the contact radius (mm). It comes from alignment: the three numbers
that best explain the picture with fixed colours. Alignment uses the picture that it explains, like the manual alignment
of Taxim's authors; colours are never fitted to a picture of the test set.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.optics.real_presses import PIXEL_MM, BallTable, Presses, ball_table, changed_centre
from robot.sim.gel.fitted_optics import normal_features, place_terms

Matrix = NDArray[np.float64]

STRIDE = 4  # fit every fourth pixel of a crop: neighbours are nearly equal
_ALIGN_STRIDE = 8  # three numbers need even fewer
_PROBE = np.array([0.5, 0.5, 0.02])  # px, px, mm: steps of the difference quotients
_LONGEST = np.array([6.0, 6.0, 0.1])  # maximum change of a pose per step
_DEEPEST = 0.985  # contact radius over the ball's; at the equator the slope is infinite
_FIRST_CONTACT_MM = {"gelsight": 1.8, "gelsight_mini": 0.7}  # start of the alignment
_FIRST_FRACTION = 0.9  # maximum, relative to the ball's radius


@dataclass(frozen=True)
class OpticsSetting:
    """Settings of a model; the layer's numbers shape the surface, the others its colours."""

    degree: int = 3
    places: int = 6
    ridge: float = 1e-4
    reaches_mm: tuple[float, ...] = (0.45, 1.2)
    thickness_mm: float = 4.0
    poisson: float = 0.48
    ball_mm: float = 2.0

    def table(self) -> BallTable:
        """Return the profiles of this ball on this layer."""
        return ball_table(self.ball_mm, self.thickness_mm, self.poisson, self.reaches_mm)


def first_pose(presses: Presses, index: int, setting: OpticsSetting) -> Matrix:
    """Return the start pose (3,) of the alignment; the label only places the crop."""
    contact = min(_FIRST_CONTACT_MM[presses.name], _FIRST_FRACTION * setting.ball_mm)
    return np.array([*changed_centre(presses, index), contact])


@lru_cache(maxsize=512)
def change(presses: Presses, index: int, stride: int = STRIDE) -> Matrix:
    """Return the pressed minus the unpressed picture over the crop, (pixels, 3)."""
    rows, cols = presses.crop(index)
    pressed = presses.pictures[index][rows, cols][::stride, ::stride].astype(np.float64)
    return np.reshape(pressed - presses.no_contact[rows, cols][::stride, ::stride], (-1, 3))


def features(presses: Presses, index: int, pose: Matrix, setting: OpticsSetting, stride: int = STRIDE) -> Matrix:
    """Return the features (pixels, features x places) of a press in this pose, in the order of FittedOptics."""
    rows, cols = presses.crop(index)
    y = np.arange(rows.start, rows.stop, stride, dtype=np.float64)[:, None]
    x = np.arange(cols.start, cols.stop, stride, dtype=np.float64)[None, :]
    maps = setting.table().at(float(pose[2]), (x - pose[0]) * PIXEL_MM, (y - pose[1]) * PIXEL_MM)
    (_, slope_x, slope_y), *smoothed = maps
    upright = -1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    found = normal_features(slope_x * upright, slope_y * upright, setting.degree)
    found += [part for one in smoothed for part in one]
    height, width = presses.no_contact.shape[:2]
    unit = (2 * x - width + 1) / width, (2 * y - height + 1) / height
    places = place_terms(*unit, setting.places)
    return np.stack([(one * place).ravel() for one in found for place in places], axis=-1)


# Weights ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Gram:
    """Sums of one press for least squares: A^T A, A^T b, b^T b, and the number of values in b."""

    square: Matrix
    cross: Matrix
    total: float
    values: int

    def loss(self, weights: Matrix) -> float:
        """Return the mean squared error of these weights on this press."""
        fit = np.sum(weights * (self.square @ weights)) - 2 * np.sum(weights * self.cross)
        return float((self.total + fit) / self.values)

    def part(self, columns: NDArray[np.intp]) -> "Gram":
        """Return the same press with only some of the columns."""
        return Gram(self.square[np.ix_(columns, columns)], self.cross[columns], self.total, self.values)


def gram(presses: Presses, index: int, pose: Matrix, setting: OpticsSetting) -> Gram:
    """Return the Gram matrices of one press."""
    one, target = features(presses, index, pose, setting), change(presses, index)
    return Gram(one.T @ one, one.T @ target, float(np.sum(target**2)), target.size)


def solve(grams: Sequence[Gram], ridge: float) -> Matrix:
    """Return weights (columns, 3) by ridge regression with columns scaled to unit rms; columns of zeros get 0."""
    square, cross = sum(one.square for one in grams), sum(one.cross for one in grams)
    pixels = sum(one.values for one in grams) / 3
    scale = np.sqrt(np.maximum(np.diag(square) / pixels, 1e-24))
    normal = square / np.outer(scale, scale) / pixels + ridge * np.eye(len(scale))
    return np.asarray(np.linalg.solve(normal, cross / scale[:, None] / pixels) / scale[:, None])


def columns_of(wide: OpticsSetting, narrow: OpticsSetting) -> NDArray[np.intp]:
    """Return the columns of a wide model that form a narrower one (lower degree, fewer places, same or no reaches)."""
    lit, lit_wide = (model.degree * (model.degree + 3) // 2 for model in (narrow, wide))
    chosen = [*range(lit), *range(lit_wide, lit_wide + 3 * len(narrow.reaches_mm))]
    return np.array([one * wide.places + place for one in chosen for place in range(narrow.places)], dtype=np.intp)


# Poses -----------------------------------------------------------------------------------------------------


def aligned(presses: Presses, index: int, pose: Matrix, weights: Matrix, setting: OpticsSetting, steps: int) -> Matrix:
    """Return the pose after some Gauss-Newton steps on the picture, with fixed colours (`weights`)."""
    limit = _DEEPEST * setting.ball_mm
    for _ in range(steps):
        error = _error(presses, index, pose, weights, setting)
        probes = [pose + np.where(np.arange(3) == axis, _PROBE, 0) for axis in range(3)]
        errors = [_error(presses, index, probe, weights, setting) for probe in probes]
        jacobian = (np.stack(errors, axis=-1) - error[:, None]) / _PROBE
        square = jacobian.T @ jacobian
        # A little damping, for a press without information.
        step = np.linalg.solve(square + np.diag(1e-3 * np.diag(square) + 1e-9), -jacobian.T @ error)
        pose = pose + np.clip(step, -_LONGEST, _LONGEST)
        pose[2] = np.clip(pose[2], 0.05, limit)
    return pose


def _error(presses: Presses, index: int, pose: Matrix, weights: Matrix, setting: OpticsSetting) -> Matrix:
    predicted = features(presses, index, pose, setting, _ALIGN_STRIDE) @ weights
    return np.ravel(predicted - change(presses, index, _ALIGN_STRIDE))


def align_all(presses: Presses, chosen: Sequence[int], setting: OpticsSetting, rounds: int = 8) -> Matrix:
    """Fit poses (count, 3) and colours of the chosen presses in turn; the others keep their start pose."""
    poses = np.array([first_pose(presses, index, setting) for index in range(len(presses))])
    for _ in range(rounds):
        weights = solve([gram(presses, index, poses[index], setting) for index in chosen], setting.ridge)
        for index in chosen:
            poses[index] = aligned(presses, index, poses[index], weights, setting, 1)
    return poses
