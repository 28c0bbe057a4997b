"""Measures of a ranking by their expected value where scores tie, and what chance gives them, in closed form.

A row ranks the items that it is shown; some are relevant. Recall at k is "any relevant item among the first k".
Among equal scores every order is as likely, so a constant scorer has exactly the value of chance.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput, NumericalError

Scores = NDArray[np.floating]
Mask = NDArray[np.bool_]


class FirstRelevant(NamedTuple):
    """Where the first relevant item of each row (Q,) stands: `before` items score higher, and among the `tied` that
    score the same (itself included) `right` are relevant. What scores higher is then never relevant.
    """

    before: NDArray[np.int64]
    tied: NDArray[np.int64]
    right: NDArray[np.int64]


def first_relevant(scores: Scores, relevant: Mask, shown: Mask) -> FirstRelevant:
    """Where the best relevant entry of each query stands.

    scores, relevant, shown: all (Q, N). Raises BadInput where a row is shown nothing relevant, NumericalError for a
    score that is not finite.
    """
    good = _checked(relevant, shown)
    _require_finite(scores)
    best = np.where(good, scores, -np.inf).max(1, keepdims=True)
    equal = shown & (scores == best)
    return FirstRelevant((shown & (scores > best)).sum(1), equal.sum(1), (equal & good).sum(1))


def _require_finite(scores: Scores) -> None:
    """A NaN is neither above nor equal to anything: measures would count it away without a word."""
    bad = np.flatnonzero(~np.isfinite(scores).all(axis=1))
    if len(bad):
        raise NumericalError(f"every score must be finite to be ranked; row {bad[0]} holds a NaN or infinite one")


def _checked(relevant: Mask, shown: Mask) -> Mask:
    good = relevant & shown
    empty = np.flatnonzero(~good.any(1))
    if len(empty):
        raise BadInput(f"every query must be shown something relevant; row {empty[0]} is not: leave it out, and say so")
    return good


def recall_at(k: int, first: FirstRelevant) -> NDArray[np.float64]:
    """(Q,) chance that a relevant item stands among the first k.

    Hypergeometric: of m tied items, r of them relevant, the first j hold none with probability
    prod_{i<j} (m - r - i) / (m - i).
    """
    none = np.ones(len(first.before))
    for turn in range(k):
        # The first `before` places are taken by what scores higher; past the tied ones a relevant item was found.
        left = first.tied - turn
        share = np.clip((left - first.right) / np.maximum(left, 1), 0, 1)
        none *= np.where(turn < k - first.before, share, 1)
    return 1 - none


def reciprocal_rank(first: FirstRelevant) -> NDArray[np.float64]:
    """(Q,) expected 1 / rank of the first relevant item, over all orders of equals."""
    expected = 1 / (first.before + 1.0)
    rows = np.flatnonzero(first.tied > first.right)
    cases, place = np.unique(np.transpose(first)[rows], axis=0, return_inverse=True)
    values = np.array([_expected_reciprocal(*map(int, case)) for case in cases])
    expected[rows] = values[place] if len(rows) else 0
    return expected


def _expected_reciprocal(before: int, tied: int, right: int) -> float:
    """Sum over j of P(j irrelevant come first) / (before + 1 + j)."""
    j = np.arange(tied - right + 1)
    # P(0) = r / m, and P(j + 1) = P(j) (m - r - j) / (m - 1 - j).
    steps = (tied - right - j[:-1]) / (tied - 1.0 - j[:-1])
    chance = right / tied * np.cumprod(np.append(1.0, steps))
    return float((chance / (before + 1 + j)).sum())


def first_rank(first: FirstRelevant) -> NDArray[np.float64]:
    """(Q,) expected rank, from 1, of the first relevant item."""
    return np.asarray(first.before + 1 + (first.tied - first.right) / (first.right + 1))


def average_precision(scores: Scores, relevant: Mask, shown: Mask) -> NDArray[np.float64]:
    """(Q,) expected average precision over the FULL ranking (McSherry and Najork 2008, section 2.5).

    scores, relevant, shown: all (Q, N). Cut at some rank, average precision is another measure and does not compare.
    Raises as `first_relevant` does.
    """
    good = _checked(relevant, shown)
    _require_finite(scores)
    harmonic = np.append(0.0, np.cumsum(1 / np.arange(1.0, scores.shape[1] + 1)))
    rows = zip(scores, good, shown, strict=True)
    return np.array([_precision_of_row(row[seen], row[mine], harmonic) for row, mine, seen in rows])


def _precision_of_row(every: Scores, relevant: Scores, harmonic: NDArray[np.float64]) -> float:
    """Group by group of equal scores: n tied items, r of them relevant, behind a others, b of them relevant.

    At place i of the group an item is relevant with probability r / n, and then 1 + b + (i - 1) (r - 1) / (n - 1)
    relevant items are expected up to it, among a + i in all; summed over i = 1..n.
    """
    every, relevant = np.sort(every), np.sort(relevant)
    values, r = np.unique(relevant, return_counts=True)
    end = np.searchsorted(every, values, "right")
    n, a = end - np.searchsorted(every, values, "left"), len(every) - end
    b = len(relevant) - np.searchsorted(relevant, values, "right")
    slope = (r - 1) / np.maximum(n - 1, 1)
    sums = (1 + b - slope * (a + 1)) * (harmonic[a + n] - harmonic[a]) + slope * n
    return float((r / n * sums).sum() / len(relevant))


def chance_of_recall(k: int, relevant: Mask, shown: Mask) -> NDArray[np.float64]:
    """(Q,) `recall_at` of a constant scorer."""
    return recall_at(k, _all_tied(relevant, shown))


def chance_of_reciprocal_rank(relevant: Mask, shown: Mask) -> NDArray[np.float64]:
    """(Q,) `reciprocal_rank` of a constant scorer."""
    return reciprocal_rank(_all_tied(relevant, shown))


def chance_of_average_precision(relevant: Mask, shown: Mask) -> NDArray[np.float64]:
    """(Q,) average precision of a constant scorer: with R of N relevant, p + (1 - p) H_N / N, p = (R - 1) / (N - 1)."""
    _, count, right = _all_tied(relevant, shown)
    harmonic = np.cumsum(1 / np.arange(1.0, shown.shape[1] + 1))[count - 1]
    share = (right - 1) / np.maximum(count - 1, 1)
    return np.asarray(np.where(count == right, 1.0, share + (1 - share) * harmonic / count))


def _all_tied(relevant: Mask, shown: Mask) -> FirstRelevant:
    return FirstRelevant(np.zeros(len(shown), dtype=np.int64), shown.sum(1), _checked(relevant, shown).sum(1))
