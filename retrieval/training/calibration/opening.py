"""Fit of the evidence of the opening of the fingers."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retrieval.data.dataset import Grasp
from retrieval.data.opening import believed
from retrieval.model.opening import OpeningCalibration
from retrieval.training.calibration.references import MAX_REFERENCES, reference_sets

Floats = NDArray[np.float64]
MIN_OPENING_WIDTH = 0.005
"""Smallest width and spread of log openings: grippers state 0.1 mm. Without it, equal openings have no likely width."""
MIN_OPENING_OBJECTS = 10
"""Smallest number of objects whose openings are fitted: three give a width and a floor at their bounds."""


def fit_opening(grasps: Sequence[Grasp]) -> OpeningCalibration | None:
    """Fit the evidence of openings to grasps in the order of capture, with references as in `fit_references`.

    The objects may be those that a model was fitted to. None for fewer than `MIN_OPENING_OBJECTS` objects with two
    openings, or if all openings are equal, as commanded ones are.
    """
    from scipy.optimize import minimize  # slow to import; queries do not need it

    measured = [(grasp.object_id, opening) for grasp in grasps if (opening := believed(grasp.opening_mm)) is not None]
    if not measured:
        return None
    names, openings = zip(*measured, strict=True)
    owner, logs = np.unique(names, return_inverse=True)[1], np.log(openings)
    sets = [(logs[shown], logs[rows]) for count in (MAX_REFERENCES, 1) for shown, rows in reference_sets(owner, count)]
    if len(sets) < 2 * MIN_OPENING_OBJECTS:
        return None
    weights = 1 / np.bincount(owner)[owner]
    mean = float(np.average(logs, weights=weights))
    spread = math.sqrt(np.average((logs - mean) ** 2, weights=weights))
    if spread < MIN_OPENING_WIDTH:
        return None
    queries = np.concatenate([rows for _, rows in sets])[:, None]
    padded = [np.append(shown, np.full(MAX_REFERENCES - len(shown), np.nan)) for shown, _ in sets]
    references = np.repeat(padded, [len(rows) for _, rows in sets], axis=0)
    is_reference = np.isfinite(references)

    def calibration(parameters: Floats) -> OpeningCalibration:
        floor, width = float(parameters[0]), math.exp(parameters[1])
        return OpeningCalibration(mean, spread, width, floor, len(sets) // 2, len(queries) // 2)

    def loss(parameters: Floats) -> float:
        terms = np.where(is_reference, calibration(parameters).log_density(queries, references), -np.inf)
        return -float((np.logaddexp.reduce(terms, axis=1) - np.log(is_reference.sum(1))).mean())

    bounds = [(0.05, 0.99), (math.log(MIN_OPENING_WIDTH), 0.0)]
    return calibration(minimize(loss, np.array([0.2, -3.0]), method="Nelder-Mead", bounds=bounds).x)
