"""Is the object in the catalogue at all? A statistic over the gallery, a threshold from validation objects, its ROC.

Every row is asked twice: with its object in the gallery, and with it taken out. Both galleries hold the same number of
objects (a random rival is dropped where the row's own object stands in): of more objects the best one is better by
chance alone, and a scorer that knows nothing would seem to know something.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from retrieval.calibration import Calibration, fit_calibration
from retrieval.errors import BadInput
from retrieval.evaluation.protocols import asked, gallery_words, share_below
from retrieval.evaluation.table import Measure, ScoreTable, object_scores, object_weights

_ROC_POINTS = 200


@dataclass(frozen=True)
class Gate:
    """Fitted on validation objects.

    objects: log-odds, at even odds, that an object's mean score over its photos is that of the row's own object.
    decision: log-odds that the row's object is in the gallery, from the statistic; `reject_log_odds` is the threshold
    of largest balanced accuracy.
    """

    objects: Calibration
    decision: Calibration

    @property
    def threshold(self) -> float:
        """The smallest statistic that is accepted."""
        return (self.decision.reject_log_odds - self.decision.intercept) / self.decision.slope


@dataclass(frozen=True, eq=False)
class Rejection:
    """What a gate does on other objects; roc: [false alarms, hits], from accepting none to accepting all."""

    auroc: Measure
    balanced_accuracy: Measure
    threshold: float
    roc: list[list[float]]


def fit_gate(validation: ScoreTable, *, seed: int = 0) -> Gate:
    """Fit on validation objects. Raises BadInput for fewer than two of them."""
    kept = asked(validation)
    scores, true = _gallery(kept, seed)
    objects = fit_calibration(scores.ravel(), true.ravel())
    present, absent = statistics(objects.log_odds(scores), true, seed)
    decision = fit_calibration(np.append(present, absent), np.repeat([1, 0], len(present)))
    return Gate(objects, decision)


def _gallery(table: ScoreTable, seed: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Mean scores (T, O) over all photos of each object, own ones left out, and which object is the row's own."""
    if len(table.objects) < 2:
        raise BadInput(f"to miss an object, a gallery needs two at least; got {len(table.objects)}")
    scores = object_scores(table, len(table.photo_owner), 1, seed)[0]
    return scores, np.asarray(table.touch_owner[:, None] == table.objects)


def statistics(
    log_odds: NDArray[np.float64], true: NDArray[np.bool_], seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Statistic (T,) of each row with its object in the gallery, and without; log_odds, true (T, O).

    log of the mean over objects of exp(log-odds): the likelihood ratio of "one of these, each as likely" against
    "none of these", than which no statistic parts the two better (Neyman and Pearson) where log-odds are calibrated.
    """
    keys = np.random.default_rng([seed, 3]).random(true.shape)
    dropped = np.where(true, -1, keys).argmax(1)[:, None] == np.arange(true.shape[1])
    count = true.shape[1] - 1
    with_own, without = (np.where(left_out, -np.inf, log_odds) for left_out in (dropped, true))
    return logsumexp(with_own, axis=1) - np.log(count), logsumexp(without, axis=1) - np.log(count)


def reject(gate: Gate, table: ScoreTable, *, seed: int = 0) -> Rejection:
    """Judge a gate on objects that it was not fitted on.

    auroc: chance that a row scores higher with its object in the gallery than any row without; equals count half,
    objects alike. Its values are such that their mean is that area and the spread of their object means that of the
    area (DeLong 1988; Obuchowski 1997 for clusters): v = P(present > others' absent) + P(others' present > absent) -
    area. Chance of both measures is 1/2.
    """
    kept = asked(table)
    scores, true = _gallery(kept, seed)
    present, absent = statistics(gate.objects.log_odds(scores), true, seed)
    weights = object_weights(kept.touch_owner)
    hits, alarms = share_below(present, absent, weights), 1 - share_below(absent, present, weights)
    areas = hits + alarms - np.sum(weights * hits)
    accepted = [gate.decision.log_odds(part) >= gate.decision.reject_log_odds for part in (present, absent)]
    right = (accepted[0] + 1.0 - accepted[1]) / 2
    words = f"{gallery_words(table, kept)}; each asked with its object and without, a rival dropped in its stead"
    auroc, balanced = (Measure(values[:, None], kept.touch_owner, np.array([0.5]), words) for values in (areas, right))
    return Rejection(auroc, balanced, gate.threshold, _roc(present, absent, weights))


def _roc(present: NDArray[np.float64], absent: NDArray[np.float64], weights: NDArray[np.float64]) -> list[list[float]]:
    """At most 200 corners, evenly spread over the thresholds."""
    thresholds = np.unique(np.append(present, absent))[::-1]
    points = [
        [float(weights[absent >= threshold].sum()), float(weights[present >= threshold].sum())]
        for threshold in thresholds
    ]
    points = [[0.0, 0.0], *points]
    chosen = np.unique(np.linspace(0, len(points) - 1, _ROC_POINTS).round().astype(int))
    return [points[place] for place in chosen]
