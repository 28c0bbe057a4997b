"""Guess curves of K-way tests and exact intervals; equals count by their expected place."""

from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import beta

from retrieval.errors import BadInput, NumericalError


def guess_curve(true_score: float, other_scores: ArrayLike, k: int) -> NDArray[np.float64]:
    """Chance that the true photo is found within 1..k guesses, when k - 1 of the others are drawn as rivals.

    Exact over all draws without replacement, so nothing is left to a random seed: of n others, b score higher and e
    equal; a rival set holds i of the b and j of the e with hypergeometric probability, and among j + 1 equals every
    place is as likely. Returns (k,) values that end at 1. A constant scorer gives 1/k, 2/k, ..., 1. Raises BadInput
    for fewer than k - 1 others, NumericalError for a score that is not finite.
    """
    others = np.asarray(other_scores, dtype=np.float64)
    if k < 1 or len(others) < k - 1:
        raise BadInput(f"a {k}-way test needs k >= 1 and {k - 1} other photos; got {len(others)}")
    if not (np.isfinite(others).all() and np.isfinite(true_score)):
        raise NumericalError("every score must be finite; one of a K-way test is not")
    higher, equal = int((others > true_score).sum()), int((others == true_score).sum())
    curve = np.zeros(k)
    for above in range(min(higher, k - 1) + 1):
        for tied in range(min(equal, k - 1 - above) + 1):
            ways = comb(higher, above) * comb(equal, tied)
            ways *= comb(len(others) - higher - equal, k - 1 - above - tied)
            share = ways / comb(len(others), k - 1)
            within = np.clip((np.arange(1, k + 1) - above) / (tied + 1), 0, 1)
            curve += share * within
    return curve


def binomial_interval(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Exact interval of a share (Clopper and Pearson 1934): never too narrow for independent trials."""
    if not 0 <= successes <= trials or trials < 1:
        raise BadInput(f"successes must lie within 0..trials, and trials be at least 1; got {successes} of {trials}")
    tail = (1 - level) / 2
    low = beta.ppf(tail, successes, trials - successes + 1) if successes else 0.0
    high = beta.ppf(1 - tail, successes + 1, trials - successes) if successes < trials else 1.0
    return float(low), float(high)
