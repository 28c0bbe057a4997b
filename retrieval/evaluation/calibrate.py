"""Probabilities of pairs, of objects and of none: fitted on validation objects, judged on test objects.

Ranking needs none of this. A pair of a touch and a photo has calibrated log-odds, `slope * score + intercept`; which
object it is, and whether it is any, has the posterior that queries have (`retrieval.model.posterior`). Both are fitted
for each number of grasps on its own: a method scores a set of grasps in its own way, so a set counts as one grasp whose
score is the set's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.metrics.pairs import Calibration, Threshold, fit_calibration, reliability_bins
from retrieval.metrics.table import ScoreTable, object_scores
from retrieval.model.posterior import (
    MIN_OBJECTS,
    IdentificationTrials,
    Posterior,
    ScoredTouches,
    fit_posterior_to_trials,
)

MIN_THRESHOLD_OBJECTS = 10
"""Validation objects that a threshold of pairs is fitted on."""
_PAIRS_OF_A_ROW = 8  # of each kind
_TESTS_OF_A_ROW = 4


class KWayTest(NamedTuple):
    """A K-way test: the true object among k candidates, after so many grasps, each shown by so many photos."""

    k: int
    grasps: int = 1
    photos: int = 1

    @property
    def name(self) -> str:
        """As in results.json: "k5", "k5_g5"."""
        return f"k{self.k}" + (f"_g{self.grasps}" if self.grasps > 1 else "")


@dataclass(frozen=True)
class Calibrations:
    """What validation objects say of a method's scores, by the number of grasps that a row of its tables is.

    pairs: log-odds of a touch with a photo; posteriors: which object it is, or none.
    """

    pairs: dict[int, Calibration]
    posteriors: dict[int, Posterior]

    def to_dict(self) -> dict[str, Any]:
        """JSON types: {"pairs": {"1": {...}}, "posteriors": {"1": {...}}}."""
        return {
            kind: {str(grasps): one.to_dict() for grasps, one in fitted.items()}
            for kind, fitted in (("pairs", self.pairs), ("posteriors", self.posteriors))
        }


def calibrate(validation: Mapping[int, ScoreTable], *, seed: int = 0) -> Calibrations:
    """Fit on validation objects; `validation` holds a table for each number of grasps.

    Of fewer than three objects there are no posteriors (`has_enough_objects`).
    """
    pairs = {grasps: calibrate_pairs(table, seed=seed) for grasps, table in validation.items()}
    asked_of = {
        grasps: posterior_questions(table, seed) for grasps, table in validation.items() if has_enough_objects(table)
    }
    return Calibrations(pairs, {grasps: fit_posterior_to_trials([one]) for grasps, one in asked_of.items()})


def calibrate_pairs(validation: ScoreTable, *, seed: int = 0) -> Calibration:
    """Log-odds of a row of the table with a photo, fitted on drawn pairs."""
    return fit_calibration(*draw_pairs(validation, seed))


@dataclass(frozen=True)
class PairRule:
    """Which pairs are called matches, where that comes from, or why there is no such rule.

    source: "the checkpoint" or "validation objects"; empty where there is none.
    """

    rule: Calibration | Threshold | None
    source: str = ""
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The "pair_threshold" of results.json: {"at", "from", "why_not"}; at: the score above which a pair matches."""
        at = -self.rule.intercept / self.rule.slope if isinstance(self.rule, Calibration) else None
        at = self.rule.at if isinstance(self.rule, Threshold) else at
        return {"at": at, "from": self.source or None, "reason": self.reason or None}


def pair_rule(chosen: Mapping[str, Any], validation: ScoreTable, *, seed: int = 0) -> PairRule:
    """The threshold that a checkpoint brings with it (`chosen["pair_threshold"]`), else one fitted on validation
    objects, of which `MIN_THRESHOLD_OBJECTS` are needed: between fewer a threshold falls anywhere.
    """
    if (own := chosen.get("pair_threshold")) is not None:
        return PairRule(Threshold(own), "the checkpoint")
    if (count := len(validation.with_targets.objects)) < MIN_THRESHOLD_OBJECTS:
        return PairRule(
            None,
            reason=f"pair accuracy needs a threshold: a checkpoint's own, or one fitted on {MIN_THRESHOLD_OBJECTS} "
            f"validation objects; there are {count}",
        )
    return PairRule(calibrate_pairs(validation, seed=seed), "validation objects")


def has_enough_objects(table: ScoreTable) -> bool:
    """Whether "which object, or none" can be asked: of two catalogues of two objects, with the true one and without."""
    return len(table.objects) >= MIN_OBJECTS


def posterior_questions(table: ScoreTable, seed: int = 0) -> IdentificationTrials:
    """ "Which object, or none?" for every row that has a photo to find; a row counts as one grasp.

    Objects stand in the order of `table.objects`, rows in that of `table.with_targets`. Raises BadInput for fewer than
    three objects.
    """
    kept = table.with_targets
    judged = ScoredTouches(kept.scores, kept.touch_owner, kept.photo_owner, kept.own)
    return IdentificationTrials.of(judged, np.arange(len(kept.touch_owner))[:, None], seed)


def draw_pairs(table: ScoreTable, seed: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Scores and labels (P,): up to 8 photos of each row's object (never its own), as many of other objects.

    The object of a false pair is drawn uniformly, then its photo, so that both kinds are even in every row.
    """
    kept = table.with_targets
    rng = np.random.default_rng([seed, 1])
    keys = np.where(kept.relevant & ~kept.own, rng.random(kept.own.shape), np.inf)
    true = np.argsort(keys, axis=1)[:, :_PAIRS_OF_A_ROW]
    shown = np.isfinite(np.take_along_axis(keys, true, 1))
    false = _other_photos(kept, true.shape[1], rng)
    scores = [np.take_along_axis(kept.scores, columns, 1)[shown] for columns in (true, false)]
    labels = np.repeat([1, 0], shown.sum())
    return np.concatenate(scores).astype(np.float64), labels


def _other_photos(table: ScoreTable, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """(T, count) columns of other objects, drawn with replacement."""
    objects, counts = np.unique(table.photo_owner, return_counts=True)
    if len(objects) < 2:
        raise BadInput(f"pairs need {table.column_words} of two objects at least; got {len(objects)}")
    order, start = np.argsort(table.photo_owner, kind="stable"), np.cumsum(counts) - counts
    other = rng.integers(len(objects) - 1, size=(len(table.touch_owner), count))
    other += other >= np.searchsorted(objects, table.touch_owner)[:, None]
    return np.asarray(order[start[other] + (rng.random(other.shape) * counts[other]).astype(np.int64)])


def draw_k_way_tests(
    table: ScoreTable, choice: KWayTest, seed: int, posterior: Posterior | None = None
) -> NDArray[np.float64]:
    """Scores (Q, k) of candidates, the true one first; rivals drawn uniformly, 4 tests a row.

    posterior: what makes one logit of a candidate's photos, in place of their mean. Raises BadInput for fewer than
    two objects; with fewer than k there are as many candidates as objects.
    """
    kept = table.with_targets
    scores = object_scores(kept, choice.photos, _TESTS_OF_A_ROW, seed, posterior.object_logits if posterior else None)
    count = min(choice.k, len(kept.objects))
    if count < 2:
        raise BadInput(f"a choice needs two objects at least; got {len(kept.objects)}")
    # The true object gets the smallest key, so it always comes first.
    true = kept.touch_owner[:, None] == kept.objects
    keys = np.random.default_rng([seed, 2]).random(scores.shape) - true
    return np.take_along_axis(scores, np.argsort(keys, axis=2)[..., :count], 2).reshape(-1, count)


def reliability(
    calibrations: Calibrations, test: Mapping[int, ScoreTable], choices: Sequence[KWayTest], *, seed: int = 0
) -> dict[str, Any]:
    """How often what was said came true, on test objects: {"pairs": ..., "k5": ..., "k5_g5": ...}.

    "pairs" (even odds, one grasp): probability and truth of pairs. A choice: the posterior's probability of the first
    guess where one candidate is known to be true (a prior of none of 0), and whether it was right (equals share it).
    A choice without a posterior, or among more candidates than there are test objects, is left out.
    """
    scores, labels = draw_pairs(test[1], seed)
    found = {"pairs": reliability_bins(calibrations.pairs[1].probability(scores), labels)}
    for choice in choices:
        table, posterior = test.get(choice.grasps), calibrations.posteriors.get(choice.grasps)
        if table and posterior and len(table.objects) >= choice.k:
            logits = draw_k_way_tests(table, choice, seed, posterior)
            found[choice.name] = reliability_bins(*top1_confidences(logits, posterior).T)
    return found


def top1_confidences(logits: NDArray[np.float64], posterior: Posterior) -> NDArray[np.float64]:
    """(Q, 2): the stated probability of the first guess among candidates of which one is true, and whether it is right
    (equals share it); logits (Q, k), the true candidate first.
    """
    tied = logits == logits.max(1, keepdims=True)
    said = [posterior.probabilities(row, none_prior=0).objects.max() for row in logits]
    return np.column_stack([said, tied[:, 0] / tied.sum(1)])
