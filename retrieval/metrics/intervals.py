"""Values with 95 % intervals resampled by OBJECT, and paired comparisons of two methods.

What a value means: the mean over objects of the mean over the object's queries; over training seeds first, where
there are several. What an interval covers: other objects drawn as these were. What it does not: another recording,
rig, light or split, and, since seeds are averaged first, more training seeds than those that ran. Queries of one
object are alike; resampled one by one they give intervals that are far too narrow.

Few objects cannot show how much objects differ. How often the interval held the truth, of 4,000 samples each of object
means that are normal, and of shares drawn as Beta(2.8, 1.2) and counted in 20 queries:

    objects   2    3    4    5    6    7    8    9   10
    normal   50   74   87   91   93   94   94   94   94 %
    shares   56   76   89   91   92   94   95   95   94 %

So results say `few_objects` where there are fewer than 5, and every table marks these intervals.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from retrieval.errors import BadInput
from retrieval.metrics.measure import Measure

LEVEL = 0.95
FEW_OBJECTS = 5
"""With fewer, an interval holds the truth far less often than LEVEL."""

_EXACT_UP_TO = 18  # objects: 2 ** 17 sign flips, the other half being their mirror image


def summarise(measures: Sequence[Measure], *, draws: int = 10_000, seed: int = 0) -> dict[str, Any]:
    """The "summary" of results.json: one measure a training seed, in the order of the seeds.

    {"value": [m], "low": [m], "high": [m], "chance": [m], "queries", "objects", "few_objects": whether so few that
    the interval says less than it should, "gallery", "by_seed": [[m], ...]}.
    """
    means = _object_means(measures)
    every = means.mean(0)
    low, high = bootstrap_interval(every, draws=draws, seed=seed)
    first, value = measures[0], every.mean(0)
    return {
        "value": value.tolist(),
        # A mean of equal numbers is rounded, and may lie past them by the last digit.
        "low": np.minimum(np.clip(low, 0, 1), value).tolist(),
        "high": np.maximum(np.clip(high, 0, 1), value).tolist(),
        "chance": first.chance.tolist(),
        "queries": len(first.owner),
        "objects": int(means.shape[1]),
        "few_objects": means.shape[1] < FEW_OBJECTS,
        "gallery": first.gallery,
        "by_seed": means.mean(1).tolist(),
    }


def _object_means(measures: Sequence[Measure]) -> NDArray[np.float64]:
    """(seeds, objects, m). Raises BadInput unless all have the same queries."""
    if not measures:
        raise BadInput("a summary needs the measure of one training seed at least; got none")
    for measure in measures[1:]:
        if measure.values.shape[1] != measures[0].values.shape[1] or not np.array_equal(
            measure.owner, measures[0].owner
        ):
            raise BadInput("measures that are put together must hold the same queries; score them on the same queries")
    return np.array([measure.by_object()[1] for measure in measures])


def bootstrap_interval(
    means: NDArray[np.float64], *, draws: int = 10_000, seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ends (m,) of the interval of the mean of object means (R, m): the expanded percentile bootstrap.

    Quantiles of the means of `draws` resamples, taken further out (Hesterberg 2015, arXiv 1411.5279): at
    Phi(-sqrt(n / (n - 1)) t), because n resampled objects vary less than n new ones. Objects that are all equal show
    no spread, and the interval is that value, however few they are; one object says nothing of others: (-inf, inf).
    """
    count = len(means)
    if count < 2:
        return np.full(means.shape[1], -np.inf), np.full(means.shape[1], np.inf)
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=draws)
    tail = norm.cdf(-np.sqrt(count / (count - 1)) * t.ppf((1 + LEVEL) / 2, count - 1))
    low, high = np.quantile(drawn @ means / count, (tail, 1 - tail), axis=0)
    same = (means == means[:1]).all(0)  # a sum of equal numbers is rounded; the interval of equals is not
    return np.where(same, means[0], low), np.where(same, means[0], high)


def compare(
    a: Sequence[Measure], b: Sequence[Measure], *, column: int = 0, draws: int = 10_000, seed: int = 0
) -> dict[str, float | bool]:
    """Two methods on the same queries: {"difference": a - b, "low", "high", "few_objects", "p"}, objects being the
    units.

    column: of a guess curve, 0 is the first guess. p: two-sided sign-flip permutation test of the objects'
    differences, over all flips up to 18 objects, else over `draws` drawn ones (Phipson and Smyth 2010: none is ever
    0). It is 1 for one object or no difference. Raises BadInput unless both methods were asked the same.
    """
    if not a or not b or not np.array_equal(a[0].owner, b[0].owner):
        raise BadInput("methods are compared on the same queries; score both on the same ones")
    differences = _object_means(a).mean(0)[:, column] - _object_means(b).mean(0)[:, column]
    low, high = bootstrap_interval(differences[:, None], draws=draws, seed=seed)
    return {
        "difference": float(differences.mean()),
        "low": float(np.clip(low[0], -1, 1)),
        "high": float(np.clip(high[0], -1, 1)),
        "few_objects": len(differences) < FEW_OBJECTS,
        "p": sign_flip_p(differences, draws=draws, seed=seed),
    }


def sign_flip_p(differences: NDArray[np.float64], *, draws: int = 10_000, seed: int = 0) -> float:
    """Share of sign flips of the differences (R,) whose mean is as far from 0 as theirs, theirs among them."""
    seen = abs(differences.sum())
    # Sums of the same numbers in another order differ by rounding; they count as equal.
    least = seen - 1e-12 * np.abs(differences).sum()
    if len(differences) <= _EXACT_UP_TO:
        return float((np.abs(_flipped_sums(differences)) >= least).mean())
    signs = np.random.default_rng(seed).choice((-1.0, 1.0), (draws, len(differences)))
    return float((1 + (np.abs(signs @ differences) >= least).sum()) / (1 + draws))


def _flipped_sums(differences: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums (2 ** (R - 1),) over every choice of signs, the first kept as it is."""
    sums = differences[:1]
    for difference in differences[1:]:
        sums = np.concatenate([sums + difference, sums - difference])
    return sums
