"""Fit of the posterior to identification trials, over catalogues with the true object and without it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.model.posterior import MAX_GRASPS, SLOPE_BOUNDS, Posterior
from retrieval.training.calibration.scores import MIN_OBJECTS, Numbers, ScoredTouches

Floats = NDArray[np.float64]
CATALOGUE_SIZES = (20, 1000)
"""Numbers of objects in the catalogues of a fit. The maximum is the number of validation objects minus one."""
_SETS = 4


def fit_posterior(*parts: ScoredTouches, seed: int = 0) -> Posterior:
    """Fit on single touches of validation objects and, if objects have more, on sets of up to `MAX_GRASPS` grasps.

    `parts` come from one or several matchers (of folds) and share no object. If each object has one grasp, the
    dependence cannot be fitted and is 1. Raises BadInput for fewer than three objects, or if no touch has another photo
    of its object.
    """
    return fit_posterior_to_trials([trial for scored in parts for trial in identification_trials(scored, seed)])


def identification_trials(scored: ScoredTouches, seed: int) -> Iterator["IdentificationTrials"]:
    """Yield the trials of single touches, then of sets of two grasps, three and so on, while objects have enough."""
    for grasps in range(1, MAX_GRASPS + 1):
        sets = scored.draw_sets(grasps, None if grasps == 1 else _SETS, np.random.default_rng([seed, grasps]))
        if len(sets) or grasps == 1:
            yield IdentificationTrials.of(scored, sets, seed)


@dataclass(frozen=True, eq=False)
class IdentificationTrials:
    """Open-set identification trials over catalogues with the true object and without it.

    Attributes:
        grasps: Touches in a query.
        scores: (T, N) summed match logits, photos sorted by object, -inf for a masked photo.
        counts: (T, O) number of unmasked photos of each object.
        starts: (O,) first photo of each object.
        catalogues: (T, K + 1) objects, the true one first. First K columns: a catalogue with it; last K: one without.
    """

    grasps: int
    scores: Floats
    counts: Numbers
    starts: Numbers
    catalogues: tuple[Numbers, ...]

    @classmethod
    def of(cls, scored: ScoredTouches, sets: Numbers, seed: int = 0) -> "IdentificationTrials":
        """Return the trials of sets (S, G) of touches. Raises BadInput for no sets or fewer than 3 objects."""
        objects, owner = np.unique(scored.photo_owner, return_inverse=True)
        if len(objects) < MIN_OBJECTS or not len(sets):
            raise BadInput(
                "a posterior requires at least three objects, and touches that have another photo of their object; "
                f"got {len(objects)} objects and {len(sets)} such touches"
            )
        order = np.argsort(owner, kind="stable")
        starts = np.searchsorted(owner[order], np.arange(len(objects)))
        in_gallery = ~np.asarray(scored.own[sets].any(axis=1))[:, order]
        scores = np.where(in_gallery, scored.logits[:, order].astype(np.float64)[sets].sum(1), -np.inf)
        counts = np.add.reduceat(in_gallery.astype(np.int64), starts, axis=1)
        true = np.searchsorted(objects, scored.touch_owner[sets[:, 0]])
        keys = np.random.default_rng([seed, 100 + sets.shape[1]]).random(counts.shape)
        keys[np.arange(len(sets)), true] = -1
        ranked = np.argsort(keys, axis=1)
        sizes = sorted({min(size, len(objects) - 1) for size in CATALOGUE_SIZES})
        return cls(sets.shape[1], scores, counts, starts, tuple(ranked[:, : size + 1] for size in sizes))

    def log_ratios(self, posterior: Posterior) -> Floats:
        """Return the log likelihood ratios (T, O) of the objects."""
        scaled = posterior.weight(self.grasps) * self.scores
        counts = np.maximum(self.counts, 1)  # an object without photos is in no catalogue
        top = np.maximum.reduceat(scaled, self.starts, axis=1)
        base = np.where(np.isfinite(top), top, 0.0)
        owner = np.repeat(np.arange(len(self.starts)), np.diff(np.append(self.starts, scaled.shape[1])))
        sums = np.add.reduceat(np.exp(scaled - base[:, owner]), self.starts, axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(base + (np.log(sums) - np.log(counts)) + posterior.offset)

    def loss(self, posterior: Posterior, smooth: float) -> float:
        """Return the mean cross-entropy over catalogues, at even odds of "none of these".

        `smooth` is the part of the target that is spread evenly over all hypotheses.
        """
        ratios, losses = self.log_ratios(posterior), []
        for catalogue in self.catalogues:
            odds = np.take_along_axis(ratios, catalogue, 1) - math.log(catalogue.shape[1] - 1)
            for part, truth in ((odds[:, :-1], 1), (odds[:, 1:], 0)):
                logs = np.column_stack([np.zeros(len(part)), part])
                logs = logs - np.logaddexp.reduce(logs, axis=1, keepdims=True)
                losses.append(-((1 - smooth) * logs[:, truth] + smooth * logs.mean(1)).mean())
        return float(np.mean(losses))


def mean_loss(trials: Sequence[IdentificationTrials], posterior: Posterior) -> float:
    """Return the mean loss over all queries, with targets smoothed as in Platt (1999, section 2.2)."""
    count = sum(len(part.scores) for part in trials)
    return sum(len(part.scores) * part.loss(posterior, 1 / (count + 2)) for part in trials) / count


def fit_posterior_to_trials(trials: Sequence[IdentificationTrials]) -> Posterior:
    """Return the most likely posterior for all of these trials, each with weight 1.

    Targets are smoothed as in Platt (1999, section 2.2), so the optimum is finite even if the logits separate all
    trials. The slope stays within `SLOPE_BOUNDS`.
    """
    from scipy.optimize import minimize  # slow to import; queries do not need it

    count = sum(len(part.scores) for part in trials)
    several = any(part.grasps > 1 for part in trials)
    finite = np.concatenate([part.scores[np.isfinite(part.scores)] / part.grasps for part in trials])
    # Subtract the median from the logits. Then the best offset hardly depends on the slope, and the search finds both.
    middle, unit = float(np.median(finite)), float(np.std(finite))
    low, high = np.log(SLOPE_BOUNDS)
    start = float(np.clip(-math.log(unit) if unit > 0 else 0.0, low, high))

    def posterior_of(parameters: Floats) -> Posterior:
        slope = float(np.clip(np.exp(parameters[0]), *SLOPE_BOUNDS))
        dependence = float(parameters[2]) if several else 1.0  # single grasps do not determine it
        return Posterior(slope, float(parameters[1]) - slope * middle, dependence, count)

    searched = slice(3 if several else 2)
    bounds = [(low, high), (-1e6, 1e6), (0.0, 1.0)][searched]
    first = np.array([start, 0.0, 0.5])[searched]
    simplex = np.vstack([first, first + np.diag([-0.5 if start > 0 else 0.5, 0.5, 0.25][searched])])
    options = {"xatol": 1e-4, "fatol": 1e-9, "maxiter": 2000, "initial_simplex": simplex}
    found = minimize(
        lambda x: mean_loss(trials, posterior_of(x)), first, method="Nelder-Mead", bounds=bounds, options=options
    )
    return posterior_of(found.x)
