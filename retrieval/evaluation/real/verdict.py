"""Summing up over seeds: values with intervals, what is left when touches are blurred, and whether that is touch."""

from collections.abc import Mapping, Sequence
from typing import Any

from retrieval.evaluation.real.protocol import Protocol
from retrieval.metrics.binomial import clopper_pearson
from retrieval.metrics.intervals import LEVEL, compare, summarise
from retrieval.metrics.measure import Measure

RULE = (
    "A result counts as touch only where its first measure beats that of the same method on blurred touches by more "
    "than the difference's interval."
)

BySeed = Sequence[Mapping[str, Measure]]


def row_entry(protocol: Protocol, touch: BySeed, blurred: BySeed, *, draws: int, seed: int) -> dict[str, Any]:
    """The numbers of a row: measures of touches, of blurred touches, the paired differences, and the verdict.

    blurred is empty for a method that looks at nothing, which has no verdict.
    """
    measures = _summaries(touch, draws, seed)
    entry: dict[str, Any] = {"measures": measures, "blurred": None, "differences": None, "verdict": None}
    entry["counted"] = _counted(touch, protocol.counted)
    if blurred:
        entry["blurred"] = _summaries(blurred, draws, seed)
        entry["differences"] = {
            name: compare([one[name] for one in touch], [one[name] for one in blurred], draws=draws, seed=seed)
            for name in measures
        }
        entry["verdict"] = verdict(measures[protocol.main], entry["differences"][protocol.main])
    return entry


def control_entry(
    protocol: Protocol, what: str, why_not: str | None, taken: BySeed, *, draws: int, seed: int
) -> dict[str, Any]:
    """The numbers of a control, or why there are none."""
    return {
        "what": what,
        "why_not": why_not,
        "measures": _summaries(taken, draws, seed) if taken else None,
        "counted": _counted(taken, protocol.counted),
    }


def verdict(summary: Mapping[str, Any], difference: Mapping[str, Any]) -> dict[str, Any]:
    """Whether a row's main measure counts as touch, and why, in words."""
    counts = difference["low"] > 0
    by, low, high = (100 * difference[key] for key in ("difference", "low", "high"))
    points = f"{by:+.1f} points [{low:+.1f}, {high:+.1f}]"
    above = summary["low"][0] > summary["chance"][0]
    if counts:
        words = f"counts as touch: {points} over the blurred control"
    elif difference["high"] < 0:
        words = f"does not count as touch: {points} below the blurred control"
    else:
        words = f"does not count as touch: {points} against the blurred control, an interval that holds 0"
    return {"counts_as_touch": bool(counts), "above_chance": bool(above), "words": words}


def _summaries(by_seed: BySeed, draws: int, seed: int) -> dict[str, Any]:
    return {name: summarise([found[name] for found in by_seed], draws=draws, seed=seed) for name in by_seed[0]}


def _counted(by_seed: BySeed, name: str | None) -> dict[str, Any] | None:
    """Right first answers, by seed, and the exact interval of their mean number: the queries of all seeds are the same,
    so that more seeds make no more of them."""
    if name is None or not by_seed or any(name not in found for found in by_seed):
        return None
    values = [found[name].values[:, 0] for found in by_seed]
    right, asked = [float(one.sum()) for one in values], len(values[0])
    low, high = clopper_pearson(sum(right) / len(right), asked, LEVEL)
    return {"measure": name, "right": right, "asked": asked, "low": low, "high": high}
