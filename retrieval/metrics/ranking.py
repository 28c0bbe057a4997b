"""Measures of a ranking, and top-n accuracy of K-way tests, by their expected value under ties, in closed form.

Each row is a query; the items of its gallery are ranked by score, and some are relevant. Recall at k is "any relevant
item among the first k". All orders of equal scores are equally likely, so a constant scorer has exactly the value of
chance.

Without ties the values equal those of trec_eval: R@k is its success_k, average precision its map. trec_eval
orders equal scores by the names of the items, compares scores in single precision, and gives a query without a relevant
item the value 0; here such a query is left out. R@k is not trec_eval's recall_k, which
is the fraction of the relevant items among the first k.
"""

from math import comb

import numpy as np
from numpy.typing import NDArray

Scores = NDArray[np.floating]
Mask = NDArray[np.bool_]


def recall_at(k: int, scores: Scores, relevant: Mask, in_gallery: Mask) -> NDArray[np.float64]:
    """Return the probability (Q,) that a relevant item is among the first k.

    Hypergeometric: of m tied items, r of them relevant, the first j contain none with probability
    prod_{i<j} (m - r - i) / (m - i).

    Args:
        k: Number of first items.
        scores: (Q, N), finite.
        relevant: (Q, N); every query has a relevant item in its gallery.
        in_gallery: (Q, N) whether the item is in the query's gallery.
    """
    good = relevant & in_gallery
    best = np.where(good, scores, -np.inf).max(1, keepdims=True)
    equal = in_gallery & (scores == best)
    before, tied, right = (in_gallery & (scores > best)).sum(1), equal.sum(1), (equal & good).sum(1)
    none = np.ones(len(scores))
    for turn in range(k):
        # Higher scores take the first `before` places; after the tied items a relevant one was certainly found.
        left = tied - turn
        fraction = np.clip((left - right) / np.maximum(left, 1), 0, 1)
        none *= np.where(turn < k - before, fraction, 1)
    return 1 - none


def average_precision(scores: Scores, relevant: Mask, in_gallery: Mask) -> NDArray[np.float64]:
    """Return the expected average precision (Q,) over the FULL ranking (McSherry and Najork 2008, section 2.5).

    Average precision at a cutoff is a different measure; do not compare the two.

    Arguments are those of `recall_at`.
    """
    harmonic = np.append(0.0, np.cumsum(1 / np.arange(1.0, scores.shape[1] + 1)))
    rows = zip(scores, relevant & in_gallery, in_gallery, strict=True)
    return np.array([_precision_of_row(row[visible], row[mine], harmonic) for row, mine, visible in rows])


def _precision_of_row(every: Scores, relevant: Scores, harmonic: NDArray[np.float64]) -> float:
    """Average precision by groups of equal scores: n tied items, r relevant, after a others, b of them relevant.

    At place i of the group an item is relevant with probability r / n. The expected number of relevant items up to it
    is then 1 + b + (i - 1) (r - 1) / (n - 1), among a + i in all. The precisions are summed over i = 1..n.
    """
    every, relevant = np.sort(every), np.sort(relevant)
    values, r = np.unique(relevant, return_counts=True)
    end = np.searchsorted(every, values, "right")
    n, a = end - np.searchsorted(every, values, "left"), len(every) - end
    b = len(relevant) - np.searchsorted(relevant, values, "right")
    slope = (r - 1) / np.maximum(n - 1, 1)
    sums = (1 + b - slope * (a + 1)) * (harmonic[a + n] - harmonic[a]) + slope * n
    return float((r / n * sums).sum() / len(relevant))


def k_way_accuracies(higher: NDArray[np.int64], equal: NDArray[np.int64], others: int, k: int) -> NDArray[np.float64]:
    """Return the probability that the true photo ranks within the top 1..k, among k - 1 random others.

    The value is exact over all draws without replacement, so it does not depend on a seed. Of n others, b score higher
    and e equal. A draw contains i of the b and j of the e with hypergeometric probability, and among j + 1 equal scores
    every rank is equally likely. A constant scorer gives 1/k, 2/k, ..., 1.

    Args:
        higher: (Q,) number of others that score higher than the true photo of each query.
        equal: (Q,) number of others with an equal score.
        others: Number of others, at least k - 1.
        k: Candidates of the test.

    Returns:
        (Q, k) values that end at 1.
    """
    cases, place = np.unique(np.stack([higher, equal], axis=1), axis=0, return_inverse=True)
    curves = [_curve(int(above), int(tied), others, k) for above, tied in cases]
    return np.array(curves)[place]


def _curve(higher: int, equal: int, others: int, k: int) -> NDArray[np.float64]:
    """Return the top-n accuracies (k,) of one query."""
    curve = np.zeros(k)
    for above in range(min(higher, k - 1) + 1):
        for tied in range(min(equal, k - 1 - above) + 1):
            ways = comb(higher, above) * comb(equal, tied)
            ways *= comb(others - higher - equal, k - 1 - above - tied)
            within = np.clip((np.arange(1, k + 1) - above) / (tied + 1), 0, 1)
            curve += ways / comb(others, k - 1) * within
    return curve
