"""Values with 95 % intervals resampled by OBJECT, and paired comparisons of two methods.

A value is the mean over objects of the mean over the object's queries. With several training seeds, values are first
averaged over seeds. An interval covers other objects from the same distribution. It does not cover another recording,
rig, light or split, nor more training seeds than those that ran, because seeds are averaged first. Queries of one
object are correlated; resampling single queries gives intervals that are far too narrow.

A few objects do not show how much objects differ. Coverage of the interval over 4,000 samples, for normally distributed
object means, and for proportions drawn as Beta(2.8, 1.2) and counted in 20 queries:

    objects      2    3    4    5    6    7    8    9   10
    normal      50   74   87   91   93   94   94   94   94 %
    proportion  56   76   89   91   92   94   95   95   94 %

So results set `few_objects` for fewer than 5, and every table marks these intervals.

Values over several random splits into training and test objects: splits that share objects are not independent, so the
spread of their values alone gives intervals that are far too narrow. The variance of their mean is estimated as
`(1 / J + test / train) * s^2` (the corrected resampled t-test; Nadeau and Bengio 2003, Machine Learning 52, eq. 15),
with J splits, s^2 the variance of their values, and test and train the numbers of objects of a split. It covers other
test objects AND other training objects from the same collection. It does not cover another sensor, nor classes that the
collection lacks.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv, ndtr, stdtr, stdtrit

from retrieval.errors import BadInput
from retrieval.metrics.measure import FEW_OBJECTS, Measure

LEVEL = 0.95
DRAWS = 10_000
"""Resamples of an interval, and random sign flips of a p-value."""

_EXACT_UP_TO = 18  # objects: 2 ** 17 sign flips; the other half mirrors them


@dataclass(frozen=True)
class Summary:
    """A measure of all queries; lists have one number for each n of a top-n curve, else one number.

    Attributes:
        value: Mean over objects, then over seeds or splits.
        low: Lower end of the 95 % interval.
        high: Upper end.
        chance: Value of a constant scorer.
        queries: Number of queries of a seed; with splits, of all splits.
        objects: Number of objects, or of the units that intervals resample.
        few_objects: Whether the interval is too narrow because of few objects.
        gallery: Description of the gallery.
        repeats: The value of each seed, or of each split.
    """

    value: list[float]
    low: list[float]
    high: list[float]
    chance: list[float]
    queries: int
    objects: int
    few_objects: bool
    gallery: str
    repeats: list[list[float]]


@dataclass(frozen=True)
class Difference:
    """A paired difference on the same queries, with its 95 % interval and two-sided p-value."""

    value: float
    low: float
    high: float
    few_objects: bool
    p: float


def summarise(measures: Sequence[Measure], *, seed: int = 0) -> Summary:
    """Return the summary of a measure, given for each training seed; intervals resample objects.

    `seed` is that of the resamples. Raises BadInput unless all measures have the same queries.
    """
    means = _object_means(measures)
    every = means.mean(0)
    low, high = bootstrap_interval(every, seed=seed)
    first, value = measures[0], every.mean(0)
    return Summary(
        value=value.tolist(),
        # The mean of equal numbers may differ from them in the last digit.
        low=np.minimum(np.clip(low, 0, 1), value).tolist(),
        high=np.maximum(np.clip(high, 0, 1), value).tolist(),
        chance=first.chance.tolist(),
        queries=len(first.owner),
        objects=int(means.shape[1]),
        few_objects=means.shape[1] < FEW_OBJECTS,
        gallery=first.gallery,
        repeats=means.mean(1).tolist(),
    )


def _object_means(measures: Sequence[Measure]) -> NDArray[np.float64]:
    """Return object means (seeds, objects, m)."""
    if any(not np.array_equal(measure.owner, measures[0].owner) for measure in measures):
        raise BadInput("combined measures must have the same queries; score them on the same queries")
    return np.array([measure.by_object()[1] for measure in measures])


def bootstrap_interval(
    means: NDArray[np.float64], *, draws: int = DRAWS, seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ends (m,) of the interval of the mean of object means (R, m): the expanded percentile bootstrap.

    The ends are quantiles of the means of resamples, moved outward (Hesterberg 2015, arXiv 1411.5279) to
    Phi(-sqrt(n / (n - 1)) t), because n resampled objects vary less than n new ones. If all objects are equal, the
    interval is their value, however few they are. A single object gives (-inf, inf).
    """
    count = len(means)
    if count < 2:
        return np.full(means.shape[1], -np.inf), np.full(means.shape[1], np.inf)
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=draws)
    tail = ndtr(-np.sqrt(count / (count - 1)) * stdtrit(count - 1, (1 + LEVEL) / 2))
    low, high = np.quantile(drawn @ means / count, (tail, 1 - tail), axis=0)
    same = (means == means[:1]).all(0)  # a sum of equal numbers is rounded; the interval of equal means must not be
    return np.where(same, means[0], low), np.where(same, means[0], high)


def compare(a: Sequence[Measure], b: Sequence[Measure], *, seed: int = 0) -> Difference:
    """Return the first value of `a` minus that of `b` on the same queries, with objects as the units.

    The p-value is that of a two-sided sign-flip permutation test on the objects' differences. Up to 18 objects it uses
    all flips, else random ones (Phipson and Smyth 2010: p is never 0). The p-value is 1 for one object or no
    difference. Each method has one measure per training seed. Raises BadInput unless all have the same queries.
    """
    means = _object_means([*a, *b])[..., 0]
    differences = means[: len(a)].mean(0) - means[len(a) :].mean(0)
    low, high = bootstrap_interval(differences[:, None], seed=seed)
    return Difference(
        value=float(differences.mean()),
        low=float(np.clip(low[0], -1, 1)),
        high=float(np.clip(high[0], -1, 1)),
        few_objects=len(differences) < FEW_OBJECTS,
        p=sign_flip_p(differences, seed=seed),
    )


def sign_flip_p(differences: NDArray[np.float64], *, seed: int = 0) -> float:
    """Return the fraction of sign flips of the differences (R,) whose mean is at least as far from 0 as observed."""
    observed = abs(differences.sum())
    # Sums of the same numbers in another order differ by rounding; they are treated as equal.
    threshold = observed - 1e-12 * np.abs(differences).sum()
    if len(differences) <= _EXACT_UP_TO:
        sums = differences[:1]  # over every choice of signs, with the first sign fixed
        for difference in differences[1:]:
            sums = np.concatenate([sums + difference, sums - difference])
        return float((np.abs(sums) >= threshold).mean())
    signs = np.random.default_rng(seed).choice((-1.0, 1.0), (DRAWS, len(differences)))
    return float((1 + (np.abs(signs @ differences) >= threshold).sum()) / (1 + DRAWS))


# Splits ----------------------------------------------------------------------------------------------------


def summarise_splits(splits: Sequence[Measure], ratio: float) -> Summary:
    """Return the summary of a measure over at least two splits; `ratio`: test objects per training object of one."""
    means = _means(splits)
    value, margin = means.mean(0), _margin(means, ratio)
    return Summary(
        value=value.tolist(),
        low=np.clip(value - margin, 0, 1).tolist(),
        high=np.clip(value + margin, 0, 1).tolist(),
        chance=np.mean([one.chance for one in splits], axis=0).tolist(),
        queries=sum(len(one.owner) for one in splits),
        objects=len(np.unique(np.concatenate([one.owner for one in splits]))),
        few_objects=len(splits) < FEW_OBJECTS,
        gallery=splits[0].gallery,
        repeats=means.tolist(),
    )


def compare_splits(a: Sequence[Measure], b: Sequence[Measure], ratio: float) -> Difference:
    """Return the first value of `a` minus that of `b`, paired by split; p is that of the corrected t-test."""
    differences = (_means(a) - _means(b))[:, [0]]
    value, margin = float(differences.mean()), float(_margin(differences, ratio)[0])
    scale = margin / stdtrit(len(differences) - 1, (1 + LEVEL) / 2)
    p = float(2 * stdtr(len(differences) - 1, -abs(value) / scale)) if scale else float(value == 0)
    return Difference(value, max(value - margin, -1.0), min(value + margin, 1.0), len(differences) < FEW_OBJECTS, p)


def _means(splits: Sequence[Measure]) -> NDArray[np.float64]:
    """Return the values (J, m) of the splits, with objects of equal weight."""
    if len(splits) < 2:
        raise BadInput(f"a spread over splits needs at least two splits; got {len(splits)}")
    return np.array([one.by_object()[1].mean(0) for one in splits])


def _margin(means: NDArray[np.float64], ratio: float) -> NDArray[np.float64]:
    count = len(means)
    spread = np.sqrt((1 / count + ratio) * means.var(0, ddof=1))
    return np.asarray(stdtrit(count - 1, (1 + LEVEL) / 2) * spread)


# Proportions -----------------------------------------------------------------------------------------------


def grouped_interval(correct: Sequence[Sequence[bool]]) -> tuple[float, float]:
    """Return the 95 % interval of the fraction of correct answers, given group by group (such as by object).

    Answers of one group are correlated, so this is the exact binomial interval for the equivalent number of independent
    answers (Korn and Graubard 1998): their number divided by the design effect (at least 1), the ratio of the variance
    between groups to that of independent answers. If all answers are correct, or all wrong, groups show no difference,
    and every answer is treated as independent. A few groups do not show how much groups differ: over 1,500 samples with
    20 answers a group and proportions drawn as Beta(2.8, 1.2), coverage was 79 % with 2 groups, 86, 89, 92, 92, 92 and
    93 % with 3 to 8, and 94 % with 9 and 10. Without answers it is 0 to 1.
    """
    total, successes = sum(map(len, correct)), sum(map(sum, correct))
    if not 0 < successes < total or len(correct) < 2:
        return binomial_interval(successes, total)
    fraction = successes / total
    squares = sum((sum(part) - fraction * len(part)) ** 2 for part in correct) * len(correct) / (len(correct) - 1)
    effective = total / max(1.0, squares / (total * fraction * (1 - fraction)))
    return binomial_interval(fraction * effective, effective)


def binomial_interval(successes: float, trials: float) -> tuple[float, float]:
    """Return the exact interval of a proportion (Clopper and Pearson 1934): conservative for independent trials.

    The numbers need not be whole.
    """
    tail = (1 - LEVEL) / 2
    low = betaincinv(successes, trials - successes + 1, tail) if successes else 0.0
    high = betaincinv(successes + 1, trials - successes, 1 - tail) if successes < trials else 1.0
    return float(low), float(high)
