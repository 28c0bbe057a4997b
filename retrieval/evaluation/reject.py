"""Is the object in the catalogue at all? The posterior's answer, its errors, and the risk of a first guess.

Every row is asked twice: with its object in the gallery, and with it taken out. Both galleries hold the same number of
objects (a random rival is dropped where the row's own object stands in): of more objects the best one is better by
chance alone, and a scorer that knows nothing would seem to know something.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from retrieval.evaluation.calibrate import posterior_questions
from retrieval.metrics.measure import Measure, object_weights, weight_below
from retrieval.metrics.table import ScoreTable
from retrieval.model.posterior import Posterior

TRUE_ACCEPTS = 0.95
_CURVE_POINTS = 200
_IDENTITY_POSTERIOR = Posterior(slope=1.0, offset=0.0)
"""Takes logs of likelihood ratios as logits."""

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Rejection:
    """What a posterior says of other objects than it was fitted on.

    roc: [false accepts, true accepts], from accepting none to accepting all. risk_coverage: [share answered, share of
    wrong first guesses among these], half of the queries without their object; from the surest answers to all.
    """

    auroc: Measure
    balanced_accuracy: Measure
    false_accepts_at_95: Measure
    roc: list[list[float]]
    risk_coverage: list[list[float]]


class Galleries(NamedTuple):
    """Logs of likelihood ratios (T, O), -inf outside the gallery: with each row's object, and without."""

    present: Floats
    absent: Floats


def galleries(ratios: Floats, true: Bools, seed: int = 0) -> Galleries:
    """Each holds all objects but one: a random rival is dropped, or the row's own. ratios, true (T, O)."""
    keys = np.random.default_rng([seed, 3]).random(true.shape)
    dropped = np.where(true, -1, keys).argmax(1)[:, None] == np.arange(true.shape[1])
    return Galleries(*(np.where(left_out, -np.inf, ratios) for left_out in (dropped, true)))


def statistic(gallery: Floats) -> Floats:
    """Log-odds (T,), at even prior, that a row's object is in the gallery: log of the mean likelihood ratio.

    No statistic parts "one of these, each as likely" from "none of these" better (Neyman and Pearson), where the
    ratios are what they say.
    """
    return np.asarray(logsumexp(gallery, axis=1) - np.log(np.isfinite(gallery).sum(1)))


def reject(posterior: Posterior, table: ScoreTable, *, seed: int = 0) -> Rejection:
    """FusionScorer a posterior on objects that it was not fitted on; at even prior of "none of these".

    auroc: chance that a row's statistic is higher with its object in the gallery than any row's without; equals count
    half, objects alike. balanced_accuracy: accepted where "one of these" is as likely as none, or likelier.
    false_accepts_at_95: share accepted without the object by the threshold that accepts 95 % with it. Chance is 1/2,
    1/2 and .95. Raises BadInput for fewer than three objects.
    """
    kept = table.with_targets
    true = np.asarray(kept.touch_owner[:, None] == kept.objects)
    shown = galleries(posterior_questions(kept, seed).log_ratios(posterior), true, seed)
    present, absent = map(statistic, shown)
    weights = object_weights(kept.touch_owner)
    words = f"{table.gallery}; each asked with its object and without, a rival dropped in its stead"

    def measure(values: Floats, chance: float) -> Measure:
        return Measure(values[:, None], kept.touch_owner, np.array([chance]), words)

    return Rejection(
        auroc=measure(_areas(present, absent, weights), 0.5),
        balanced_accuracy=measure(((present >= 0) + 1.0 - (absent >= 0)) / 2, 0.5),
        false_accepts_at_95=measure(_false_accepts(present, absent, kept.touch_owner), TRUE_ACCEPTS),
        roc=_roc(present, absent, weights),
        risk_coverage=_risk_coverage(shown, true, weights),
    )


def _areas(present: Floats, absent: Floats, weights: Floats) -> Floats:
    """Values (T,) whose mean is the area under the curve, and whose object means spread as the area does.

    DeLong 1988; Obuchowski 1997 for clusters: v = P(present > others' absent) + P(others' present > absent) - area.
    """
    hits, alarms = weight_below(present, absent, weights), 1 - weight_below(absent, present, weights)
    return np.asarray(hits + alarms - np.sum(weights * hits))


def _false_accepts(present: Floats, absent: Floats, owner: NDArray[np.int64]) -> Floats:
    """Values (T,) whose mean is the share of false accepts, and whose object means spread as that share does.

    The threshold comes from the same queries, so an object moves the share by its true accepts too: its value is the
    jackknife's, from the share without it.
    """
    weights = object_weights(owner)
    share = _false_accept_share(present, absent, weights)
    objects, place = np.unique(owner, return_inverse=True)
    if len(objects) == 1:
        return np.full(len(owner), share)
    without = [
        _false_accept_share(present[rest], absent[rest], object_weights(owner[rest]))
        for rest in (owner != name for name in objects)
    ]
    moved = (len(objects) - 1) * (np.mean(without) - np.array(without))
    return np.asarray((share + moved)[place])


def _false_accept_share(present: Floats, absent: Floats, weights: Floats) -> float:
    """The share of questions without the object that are accepted by the threshold that accepts 95 % of those with it;
    of equals at the threshold so large a part that it is 95 % exactly.
    """
    order = np.argsort(-present, kind="stable")
    accepted = np.cumsum(weights[order])
    threshold = present[order][min(int(np.searchsorted(accepted, TRUE_ACCEPTS * accepted[-1])), len(order) - 1)]
    tied, above = (weights[found(present, threshold)].sum() for found in (np.equal, np.greater))
    part = (TRUE_ACCEPTS * accepted[-1] - above) / tied
    return float(weights[absent > threshold].sum() + part * weights[absent == threshold].sum())


def _roc(present: Floats, absent: Floats, weights: Floats) -> list[list[float]]:
    thresholds = np.unique(np.append(present, absent))[::-1]
    points = [
        [float(weights[absent >= threshold].sum()), float(weights[present >= threshold].sum())]
        for threshold in thresholds
    ]
    return _thin_points([[0.0, 0.0], *points])


def _risk_coverage(shown: Galleries, true: Bools, weights: Floats) -> list[list[float]]:
    """The surest answers first, by the probability of the first guess; equal ones are answered together.

    Of equal first guesses each is as likely to be the answer.
    """
    first = np.concatenate([gallery == gallery.max(1, keepdims=True) for gallery in shown])
    wrong = 1 - (first & np.tile(true, (2, 1))).sum(1) / first.sum(1)
    sure = np.array(
        [_IDENTITY_POSTERIOR.probabilities(row[np.isfinite(row)]).objects.max() for row in np.concatenate(shown)]
    )
    share = np.tile(weights, 2) / 2
    levels, place = np.unique(-sure, return_inverse=True)
    answered, failed = (np.cumsum(np.bincount(place, part, len(levels))) for part in (share, share * wrong))
    return _thin_points(np.stack([answered / answered[-1], failed / answered], axis=1).tolist())


def _thin_points(points: list[list[float]]) -> list[list[float]]:
    """At most 200 of the points, evenly spread over them."""
    chosen = np.unique(np.linspace(0, len(points) - 1, _CURVE_POINTS).round().astype(int))
    return [points[place] for place in chosen]
