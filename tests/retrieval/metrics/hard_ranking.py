"""Rankings with NaN and with ties, partial activations at the limits of float16, and intervals of very few objects."""

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import special
from torch import nn

from retrieval.metrics.intervals import binomial_interval, bootstrap_interval, sign_flip_p
from retrieval.metrics.pairs import pair_auc
from retrieval.metrics.ranking import (
    average_precision,
    k_way_accuracies,
    recall_at,
)
from retrieval.metrics.table import ScoreTable
from retrieval.model.config import MatcherConfig
from retrieval.model.fusion import FusionHead
from retrieval.training.selection import ranking_auc
from tests.hard_case import HardCase, error_of

_TOP, _MEASURES, _PARTIALS, _INTERVALS = "top k", "rank measures", "partials", "intervals"


def hard_cases() -> Iterator[HardCase]:
    """Cases of rankings."""
    yield _nan_partial()
    yield _nan_score()
    yield _sum_of_partials()
    yield _subnormal_partials()
    yield _constant_scorer()
    yield _constant_scorer_by_area()
    yield _many_rivals()
    yield _one_object()
    yield _all_right()
    yield _equal_differences()


def _adding_head(hidden: int) -> FusionHead:
    """Return a head whose logit is the sum over units of relu(touch partial + photo partial)."""
    head = FusionHead(1, 1, MatcherConfig(hidden=hidden))
    with torch.no_grad():
        nn.init.eye_(head.second.weight)
        nn.init.ones_(head.out.weight)
        for bias in (head.second.bias, head.out.bias):
            nn.init.zeros_(bias)
    return head.eval()


def _nan_partial() -> HardCase:
    partials = np.array([[1.0], [np.nan], [2.0]], np.float16)
    logits = np.maximum(partials[:, 0], 0)
    naive = np.argsort(logits)[::-1]
    ours, holds = error_of(lambda: _adding_head(1).scorer.logits(torch.zeros(1, 1).numpy(), partials), "photo row 1")
    text = f"photos {', '.join(map(str, naive))}: the NaN is best"
    case = "one of three partial activations is NaN"
    return HardCase(_TOP, case, "refused, the row named", text, ours, holds, naive[0] == 2)


def _nan_score() -> HardCase:
    scores = np.array([[0.2, np.nan, 0.9]], np.float32)
    owners = np.array([2]), np.arange(3)
    naive = torch.topk(torch.from_numpy(scores), 3).indices[0].tolist()
    ours, holds = error_of(lambda: ScoreTable(scores, *owners, np.zeros((1, 3), bool)), "row 0, column 1")
    words = f"torch.topk: photos {', '.join(map(str, naive))}"
    return HardCase(_TOP, "one score is NaN", "refused, and named", words, ours, holds, naive[0] == 2)


def _sum_of_partials() -> HardCase:
    """40000 + 40000 is infinite in float16; stored in float16 and added in float32 it is 80000."""
    partials, touch = np.array([[4e4]], np.float16), torch.tensor([[4e4]])
    naive = float((partials + touch.numpy().astype(np.float16))[0, 0])
    ours = float(_adding_head(1).scorer.logits(touch.numpy(), partials)[0])
    case = "two partial activations of 40000"
    return HardCase(_PARTIALS, case, "logit 80000", f"{naive:g}", f"{ours:g}", ours == 8e4, naive == 8e4)


def _subnormal_partials() -> HardCase:
    """1e-6 to 8e-6 are below float16's normal numbers: added to a touch of 1 in float16, all photos tie."""
    partials, touch = (np.arange(1, 9)[:, None] * 2.0**-20).astype(np.float16), torch.ones(1, 1)
    naive = (partials + np.float16(1))[:, 0]
    ours = _adding_head(1).scorer.logits(touch.numpy(), partials)
    naive_text, text = (f"{len(np.unique(scores))} distinct" for scores in (naive, ours))
    holds, tied = ours.tolist() == [1 + row * 2.0**-20 for row in range(1, 9)], len(np.unique(naive)) < 8
    expected = "8 distinct logits, 1e-6 apart"
    return HardCase(_PARTIALS, "8 photos 1e-6 apart", expected, naive_text, text, holds, not tied)


def _constant_scorer() -> HardCase:
    """A scorer that gives all of a hundred photos the same score; after sorting, the true photo may come first."""
    scores, relevant = np.zeros((1, 100)), np.arange(100)[None] == 0
    shown = np.ones_like(relevant)
    place = int(np.flatnonzero(np.argsort(-scores[0], kind="stable") == 0)[0])
    ours = [float(recall_at(1, scores, relevant, shown)[0]), float(average_precision(scores, relevant, shown)[0])]
    chance = [0.01, float((1 / np.arange(1, 101)).mean())]
    holds = bool(np.allclose(ours, chance, rtol=1e-9))
    naive = f"recall {1.0 * (place == 0)}, precision {1 / (place + 1)}"
    text = "recall {:.4g}, precision {:.4g}".format(*ours)
    expected = "recall {:.4g}, precision {:.4g}: chance".format(*chance)
    return HardCase(_MEASURES, "all of 100 photos score the same", expected, naive, text, holds, place != 0)


def _constant_scorer_by_area() -> HardCase:
    """Area under the ROC of a constant scorer: 0.5."""
    labels = np.array([1, 0, 0, 0])
    naive = float((np.zeros(1)[:, None] > np.zeros(3)).mean())
    ours = pair_auc(np.zeros(4), labels), ranking_auc(np.zeros((4, 4)), np.arange(4))
    text = ", ".join(f"{value:g}" for value in ours)
    return HardCase(
        _MEASURES,
        "area where all scores are equal",
        "0.5",
        f"{naive:g}, counting >",
        text,
        ours == (0.5, 0.5),
        naive == 0.5,
    )


def _many_rivals() -> HardCase:
    """Of 5000 photos two score higher; 999 rivals are drawn, in more ways than float64's 1e308."""
    naive = float(special.comb(4998, 999) / special.comb(5000, 999))
    ours = float(k_way_accuracies(np.array([2]), np.array([0]), 5000, 1000)[0, 0])
    must = 4001 * 4000 / (5000 * 4999)  # neither of the two is drawn
    correct = [abs(value - must) < 1e-12 for value in (naive, ours)]
    text, expected = f"{ours:.6g}", f"{must:.6g}"
    return HardCase(_MEASURES, "top-1 among 1000 of 5000", expected, f"{naive}", text, correct[1], correct[0])


def naive_interval(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return percentiles of the means of resampled values (n,)."""
    drawn = np.random.default_rng(0).integers(len(values), size=(1000, len(values)))
    low, high = np.percentile(values[drawn].mean(1), [2.5, 97.5])
    return float(low), float(high)


def _one_object() -> HardCase:
    """Forty touches of one object, 30 of them correct, carry no information about other objects."""
    touches = np.repeat([1.0, 0.0], [30, 10])
    naive = naive_interval(touches)
    low, high = (float(end[0]) for end in bootstrap_interval(touches.mean(keepdims=True)[:, None]))
    expected = "an interval that contains 0 and 1"
    return HardCase(
        "bootstrap",
        "one object, 40 touches",
        expected,
        f"{naive[0]:.3g} to {naive[1]:.3g}, resampling touches",
        f"{low} to {high}",
        low <= 0 and high >= 1,
        naive[0] <= 0 and naive[1] >= 1,
    )


def _all_right() -> HardCase:
    """Twenty of twenty: the interval must not be a point."""
    proportion, ours = 1.0, binomial_interval(20, 20)
    wide = 1.96 * np.sqrt(proportion * (1 - proportion) / 20)
    naive = f"{proportion - wide:.3g} to {proportion + wide:.3g} (p +- 1.96 s)"
    must = 0.025 ** (1 / 20)  # all 20 right with probability 2.5 %
    holds = abs(ours[0] - must) < 1e-9 and ours[1] == 1
    expected, text = f"{must:.4g} to 1", f"{ours[0]:.4g} to {ours[1]:.4g}"
    return HardCase(_INTERVALS, "20 right of 20", expected, naive, text, holds, bool(wide > 0))


def _equal_differences() -> HardCase:
    """Three objects on which one method leads by .1, .2 and .3: as far from 0 only with equal signs, 2 of 8."""
    differences = np.array([0.1, 0.2, 0.3])
    signs = np.array(np.meshgrid(*3 * [[1, -1]])).reshape(3, -1).T
    sums = np.array([(row * differences)[::-1].sum() for row in signs])
    naive = float((np.abs(sums) >= differences.sum()).mean())
    ours = sign_flip_p(differences)
    return HardCase(
        "permutation test", "differences .1, .2, .3", "p = 0.25", f"{naive}", f"{ours}", ours == 0.25, naive == 0.25
    )
