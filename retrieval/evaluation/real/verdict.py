"""Summing up: values with intervals, paired differences from the controls, and whether a result counts as touch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.evaluation.real.protocol import Protocol
from retrieval.metrics.intervals import LEVEL, compare, summarise
from retrieval.metrics.k_way import clopper_pearson
from retrieval.metrics.measure import Measure
from retrieval.metrics.resampled_splits import compare_splits, summarise_splits

RULE = (
    "A result counts as touch only where its first measure beats its controls, each by more than the interval of the "
    "paired difference: the same method on blurred touches, and the order of capture in place of the touch; where "
    "touches find touches, also the no-contact frame in place of the touch."
)
CONTROL_NAMES = {
    "low_pass_differences": "the blurred control",
    "order_differences": "the order of capture",
    "no_contact_differences": "the no-contact frame alone",
}
"""Key of a row's paired differences -> what the control is called."""
CONFIDENCE_BINS = 10

BySeed = Sequence[Mapping[str, Measure]]


@dataclass(frozen=True)
class Aggregation:
    """How measures become numbers: over seeds, intervals resampling objects; or over choices of test objects.

    ratio: test objects of a choice for each training object; None: measures are those of seeds.
    """

    draws: int
    seed: int
    ratio: float | None = None

    def summaries(self, taken: BySeed) -> dict[str, Any]:
        """Values with intervals, by name; those that all have."""
        found = {name: [one[name] for one in taken] for name in _shared(taken)}
        if self.ratio is not None:
            return {name: summarise_splits(measures, self.ratio) for name, measures in found.items()}
        return {name: summarise(measures, draws=self.draws, seed=self.seed) for name, measures in found.items()}

    def differences(self, a: BySeed, b: BySeed) -> dict[str, Any]:
        """Paired differences `a` - `b`, by name."""
        names = [name for name in _shared(a) if name in _shared(b)]
        pairs = {name: ([one[name] for one in a], [one[name] for one in b]) for name in names}
        if self.ratio is not None:
            return {name: compare_splits(*pair, self.ratio) for name, pair in pairs.items()}
        return {name: compare(*pair, draws=self.draws, seed=self.seed) for name, pair in pairs.items()}


def _shared(taken: BySeed) -> list[str]:
    return [name for name in taken[0] if all(name in one for one in taken)]


def row_entry(
    protocol: Protocol,
    touch: BySeed,
    low_pass: BySeed,
    order: BySeed,
    aggregation: Aggregation,
    no_contact: BySeed = (),
) -> dict[str, Any]:
    """The numbers of a row: measures of touches, of blurred touches, paired differences from the controls, verdict.

    blurred is empty for a method that looks at nothing, which has no verdict. order: of the control of that name.
    untouched: of the no-contact frames alone, where the verdict counts them.
    """
    measures = aggregation.summaries(touch)
    entry: dict[str, Any] = {"measures": measures, "low_pass": None, "verdict": None, **dict.fromkeys(CONTROL_NAMES)}
    entry["correct_counts"] = _correct_counts(touch, protocol.binomial_measure)
    if low_pass:
        entry["low_pass"] = aggregation.summaries(low_pass)
        entry |= {
            key: aggregation.differences(touch, one)
            for key, one in zip(CONTROL_NAMES, (low_pass, order, no_contact), strict=True)
            if one
        }
        entry["verdict"] = verdict(
            measures[protocol.main], *(entry[key][protocol.main] for key in CONTROL_NAMES if entry[key])
        )
    return entry


def control_entry(
    protocol: Protocol, description: str, reason: str | None, taken: BySeed, aggregation: Aggregation
) -> dict[str, Any]:
    """The numbers of a control, or why there are none."""
    return {
        "description": description,
        "reason": reason,
        "measures": aggregation.summaries(taken) if taken else None,
        "correct_counts": _correct_counts(taken, protocol.binomial_measure),
    }


def verdict(summary: Mapping[str, Any], *differences: Mapping[str, Any]) -> dict[str, Any]:
    """Whether a row's main measure counts as touch, and why, in words.

    differences: paired, from the first controls of `CONTROL_NAMES` in turn; all must lie above 0 with their whole
    interval.
    """
    counts = all(one["low"] > 0 for one in differences)
    found = [_against(one, name) for one, name in zip(differences, CONTROL_NAMES.values(), strict=False)]
    words = f"{'counts' if counts else 'does not count'} as touch: {'; '.join(found)}"
    above = summary["low"][0] > summary["chance"][0]
    return {"counts_as_touch": counts, "above_chance": bool(above), "words": words}


def _against(difference: Mapping[str, Any], control: str) -> str:
    by, low, high = (100 * difference[key] for key in ("difference", "low", "high"))
    points = f"{by:+.1f} points [{low:+.1f}, {high:+.1f}]"
    if low > 0:
        return f"{points} over {control}"
    if high < 0:
        return f"{points} below {control}"
    return f"{points} against {control}, an interval that holds 0"


def reliability_entry(confidences: Sequence[Mapping[str, NDArray[np.float64]]]) -> dict[str, list[dict[str, Any]]]:
    """Whether stated probabilities of first guesses came true, by what was searched: for each bin of .1 that is not
    empty {"from", "to", "stated", "true", "count"}.

    stated: for each fold, by what was searched (Q, 2), the probability and the share that is right.
    """
    names = dict.fromkeys(name for one in confidences for name in one)
    return {name: _bins(np.concatenate([one[name] for one in confidences if name in one])) for name in names}


def _bins(confidences: NDArray[np.float64]) -> list[dict[str, Any]]:
    said, right = confidences.T
    which = np.minimum((said * CONFIDENCE_BINS).astype(int), CONFIDENCE_BINS - 1)
    return [
        {
            "from": place / CONFIDENCE_BINS,
            "to": (place + 1) / CONFIDENCE_BINS,
            "confidence": float(said[which == place].mean()),
            "accuracy": float(right[which == place].mean()),
            "count": int((which == place).sum()),
        }
        for place in np.unique(which).tolist()
    ]


def _correct_counts(by_seed: BySeed, name: str | None) -> dict[str, Any] | None:
    """Right first answers, by seed, and the exact interval of their mean number: the queries of all seeds are the same,
    so that more seeds make no more of them.
    """
    if name is None or not by_seed or any(name not in found for found in by_seed):
        return None
    values = [found[name].values[:, 0] for found in by_seed]
    right, asked = [float(one.sum()) for one in values], len(values[0])
    low, high = clopper_pearson(sum(right) / len(right), asked, LEVEL)
    return {"measure": name, "right": right, "queries": asked, "low": low, "high": high}
