"""Open-set rejection: detect objects that are not in the catalogue.

Every row is scored twice: with its object in the gallery and without it. Both galleries have the same number of
objects: a random rival is dropped from the gallery with the row's own object. In a larger gallery the best score is
higher by chance, so that an uninformative scorer would seem better than chance.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from retrieval.evaluation.queries import identification_trials
from retrieval.evaluation.results import Rejection
from retrieval.metrics.measure import Measure, object_weights, weight_below
from retrieval.metrics.table import ScoreTable
from retrieval.model.posterior import Posterior

_CURVE_POINTS = 200

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def galleries(ratios: Floats, true: Bools, seed: int = 0) -> tuple[Floats, Floats]:
    """Return log-likelihood ratios (T, O) of the galleries with and without each row's object, -inf outside them.

    `ratios` (T, O) are those of all objects; `true` (T, O) is whether the object is the row's own. Each gallery lacks
    one object: a rival, drawn with `seed`, or the row's own.
    """
    keys = np.random.default_rng([seed, 3]).random(true.shape)
    dropped = np.where(true, -1, keys).argmax(1)[:, None] == np.arange(true.shape[1])
    return np.where(dropped, -np.inf, ratios), np.where(true, -np.inf, ratios)


def statistic(gallery: Floats) -> Floats:
    """Return log-odds (T,), at even prior, that a row's object is in the gallery: log of the mean likelihood ratio.

    With exact likelihood ratios no statistic separates "one of these, each equally likely" from "none of these" better
    (Neyman-Pearson lemma).
    """
    return np.asarray(logsumexp(gallery, axis=1) - np.log(np.isfinite(gallery).sum(1)))


def reject(posterior: Posterior, table: ScoreTable, *, seed: int = 0) -> Rejection[Measure]:
    """Measure the rejection performance of a posterior on the scores of objects that it was not fitted on.

    Objects have equal weight. Chance is 1/2. `seed` draws the galleries. Raises BadInput for fewer than three objects.
    """
    targets = table.with_targets
    true = np.asarray(targets.touch_owner[:, None] == targets.objects)
    present, absent = map(statistic, galleries(identification_trials(targets, seed).log_ratios(posterior), true, seed))
    weights = object_weights(targets.touch_owner)
    words = f"{table.gallery}; each query with its object in the gallery, and with a rival in its place"

    def measure(values: Floats) -> Measure:
        return Measure(values[:, None], targets.touch_owner, np.array([0.5]), words)

    # The object-weighted mean is the area under the curve; the object means give its variance (DeLong 1988; Obuchowski
    # 1997 for clustered data): v = P(present > any absent) + P(any present > absent) - area.
    hits, alarms = weight_below(present, absent, weights), 1 - weight_below(absent, present, weights)
    return Rejection(
        auroc=measure(hits + alarms - np.sum(weights * hits)),
        balanced_accuracy=measure(((present >= 0) + 1.0 - (absent >= 0)) / 2),
        roc=_roc(present, absent, weights),
    )


def _roc(present: Floats, absent: Floats, weights: Floats) -> list[list[float]]:
    """Return at most 200 points of the curve, evenly spaced."""
    thresholds = np.unique(np.append(present, absent))[::-1]
    points = [[float(weights[part >= threshold].sum()) for part in (absent, present)] for threshold in thresholds]
    chosen = np.unique(np.linspace(0, len(points), _CURVE_POINTS).round().astype(int))
    return [[[0.0, 0.0], *points][place] for place in chosen]
