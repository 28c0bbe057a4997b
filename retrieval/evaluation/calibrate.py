"""Calibration of pair and object probabilities: fitted on validation objects, evaluated on test objects.

Ranking does not need calibration. A pair of a touch and a photo has calibrated log-odds, `slope * score + intercept`.
The posterior over objects and "none of these" is that of queries (`retrieval.model.posterior`). Both are fitted
separately for each number of grasps, because each method combines the scores of several grasps in its own way: a set
is treated as one grasp with the score of the set.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.evaluation.results import PairThreshold
from retrieval.metrics.pairs import Calibration, fit_calibration, reliability_bins
from retrieval.metrics.table import ScoreTable, object_scores
from retrieval.model.posterior import Posterior
from retrieval.training.calibration.posterior import MIN_OBJECTS, IdentificationTrials, fit_posterior_to_trials
from retrieval.training.calibration.touches import ScoredTouches

MIN_THRESHOLD_OBJECTS = 10
"""Minimum number of validation objects for fitting a pair threshold."""
_PAIRS_OF_A_ROW = 8  # of each kind
_TESTS_OF_A_ROW = 4


class KWayTest(NamedTuple):
    """A K-way test: rank the true object among k candidates.

    Attributes:
        k: Number of candidates.
        grasps: Grasps of the query.
        photos: Photos of each candidate.
    """

    k: int
    grasps: int = 1
    photos: int = 1

    @property
    def name(self) -> str:
        """Name in results.json: "k5", "k5_g5"."""
        return f"k{self.k}" + (f"_g{self.grasps}" if self.grasps > 1 else "")


@dataclass(frozen=True)
class Calibrations:
    """Calibrations of one method, by the number of grasps of a table row.

    Attributes:
        pairs: Log-odds that a touch and a photo match.
        posteriors: Posterior over the objects and "none of these".
    """

    pairs: dict[int, Calibration]
    posteriors: dict[int, Posterior]

    def to_dict(self) -> dict[str, Any]:
        """Return JSON types: {"pairs": {"1": {...}}, "posteriors": {"1": {...}}}."""
        return {
            "pairs": {str(grasps): asdict(one) for grasps, one in self.pairs.items()},
            "posteriors": {str(grasps): one.to_dict() for grasps, one in self.posteriors.items()},
        }


def calibrate(validation: Mapping[int, ScoreTable], *, seed: int = 0) -> Calibrations:
    """Fit the calibrations on validation objects.

    Args:
        validation: A score table for each number of grasps.
        seed: Seed of the drawn pairs and trials.

    Returns:
        The calibrations; without posteriors for fewer than three objects (`has_enough_objects`).
    """
    pairs = {grasps: calibrate_pairs(table, seed=seed) for grasps, table in validation.items()}
    trials_of = {
        grasps: posterior_questions(table, seed) for grasps, table in validation.items() if has_enough_objects(table)
    }
    return Calibrations(pairs, {grasps: fit_posterior_to_trials([one]) for grasps, one in trials_of.items()})


def calibrate_pairs(validation: ScoreTable, *, seed: int = 0) -> Calibration:
    """Fit the log-odds of a row with a photo on drawn pairs."""
    return fit_calibration(*draw_pairs(validation, seed))


def pair_threshold(best_params: Mapping[str, Any], validation: ScoreTable, *, seed: int = 0) -> PairThreshold:
    """Return the pair threshold of a checkpoint, else one that is fitted on validation objects.

    Args:
        best_params: Parameters of the method; "pair_threshold" is the checkpoint's own threshold.
        validation: Scores of validation objects. Fewer than `MIN_THRESHOLD_OBJECTS` objects give no threshold, because
            one for so few objects is arbitrary.
        seed: Seed of the drawn pairs.
    """
    if (own := best_params.get("pair_threshold")) is not None:
        return PairThreshold(own, "the checkpoint")
    if (count := len(validation.with_targets.objects)) < MIN_THRESHOLD_OBJECTS:
        reason = "pair accuracy needs a threshold of the checkpoint, or one fitted on at least "
        return PairThreshold(None, None, f"{reason}{MIN_THRESHOLD_OBJECTS} validation objects; the split has {count}")
    fitted = calibrate_pairs(validation, seed=seed)
    return PairThreshold(-fitted.intercept / fitted.slope, "validation objects")


def has_enough_objects(table: ScoreTable) -> bool:
    """Return whether the table has enough objects for trials with and without the true object.

    Each trial needs a gallery of two objects, so three objects are the minimum.
    """
    return len(table.objects) >= MIN_OBJECTS


def posterior_questions(table: ScoreTable, seed: int = 0) -> IdentificationTrials:
    """Return an identification trial for every row that has a target photo; a row is one grasp.

    Args:
        table: The scores.
        seed: Seed of the drawn photos.

    Returns:
        The trials: objects in the order of `table.objects`, rows in the order of `table.with_targets`.

    Raises:
        BadInput: The table has fewer than three objects.
    """
    targets = table.with_targets
    scored = ScoredTouches(targets.scores, targets.touch_owner, targets.photo_owner, targets.own)
    return IdentificationTrials.of(scored, np.arange(len(targets.touch_owner))[:, None], seed)


def draw_pairs(table: ScoreTable, seed: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Draw pairs for calibration: up to 8 true photos of each row, and as many false ones.

    The photo of the row's own grasp is never drawn. For a false pair first the object is drawn uniformly, then its
    photo. Every row has as many true as false pairs.

    Args:
        table: The scores.
        seed: Seed of the draw.

    Returns:
        Scores (P,) and labels (P,), 1 for a true pair.
    """
    targets = table.with_targets
    rng = np.random.default_rng([seed, 1])
    keys = np.where(targets.relevant & ~targets.own, rng.random(targets.own.shape), np.inf)
    true = np.argsort(keys, axis=1)[:, :_PAIRS_OF_A_ROW]
    is_drawn = np.isfinite(np.take_along_axis(keys, true, 1))
    false = _other_photos(targets, true.shape[1], rng)
    scores = [np.take_along_axis(targets.scores, columns, 1)[is_drawn] for columns in (true, false)]
    labels = np.repeat([1, 0], is_drawn.sum())
    return np.concatenate(scores).astype(np.float64), labels


def _other_photos(table: ScoreTable, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return columns (T, count) of other objects, drawn with replacement."""
    objects, counts = np.unique(table.photo_owner, return_counts=True)
    if len(objects) < 2:
        raise BadInput(f"Pairs need {table.column_words} of at least 2 objects, got {len(objects)}.")
    order, start = np.argsort(table.photo_owner, kind="stable"), np.cumsum(counts) - counts
    other = rng.integers(len(objects) - 1, size=(len(table.touch_owner), count))
    other += other >= np.searchsorted(objects, table.touch_owner)[:, None]
    return np.asarray(order[start[other] + (rng.random(other.shape) * counts[other]).astype(np.int64)])


def draw_k_way_tests(
    table: ScoreTable, choice: KWayTest, seed: int, posterior: Posterior | None = None
) -> NDArray[np.float64]:
    """Draw K-way tests, 4 for each row; rivals are drawn uniformly.

    Args:
        table: The scores.
        choice: The kind of test.
        seed: Seed of the draw.
        posterior: Combines the scores of a candidate's photos into one logit; None for their mean.

    Returns:
        Scores (Q, k) of the candidates, the true one first. With fewer than k objects all of them are candidates.

    Raises:
        BadInput: The table has fewer than two objects.
    """
    targets = table.with_targets
    scores = object_scores(
        targets, choice.photos, _TESTS_OF_A_ROW, seed, posterior.object_logits if posterior else None
    )
    count = min(choice.k, len(targets.objects))
    if count < 2:
        raise BadInput(f"A K-way test needs at least 2 objects, got {len(targets.objects)}.")
    # The true object gets the smallest key, so it always comes first.
    true = targets.touch_owner[:, None] == targets.objects
    keys = np.random.default_rng([seed, 2]).random(scores.shape) - true
    return np.take_along_axis(scores, np.argsort(keys, axis=2)[..., :count], 2).reshape(-1, count)


def reliability(
    calibrations: Calibrations, test: Mapping[int, ScoreTable], choices: Sequence[KWayTest], *, seed: int = 0
) -> dict[str, Any]:
    """Return the reliability bins of calibrated probabilities on test objects.

    Args:
        calibrations: The fitted calibrations.
        test: Scores of test objects, by number of grasps.
        choices: K-way tests. One without a posterior, or with more candidates than test objects, is left out.
        seed: Seed of the drawn pairs and tests.

    Returns:
        {"pairs": bins, "k5": bins, "k5_g5": bins, ...}. "pairs": match probabilities of single touches at even prior
        odds. A K-way test: probability of the top-1 candidate when one candidate is true (prior of none: 0) against
        its accuracy; tied candidates split the credit.
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
    """Return the probability of the top-1 candidate and whether it is right, when one candidate is true.

    Args:
        logits: (Q, k), the true candidate first.
        posterior: The posterior of the logits.

    Returns:
        (Q, 2): probability; 1 if right, 0 if wrong, 1/n for n tied candidates that include the true one.
    """
    tied = logits == logits.max(1, keepdims=True)
    confidences = [
        posterior.probabilities_given(row, posterior.mass(row), none_prior=0).objects.max() for row in logits
    ]
    return np.column_stack([confidences, tied[:, 0] / tied.sum(1)])
