"""Aggregate measures: values with intervals, paired differences from the controls, and the verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from retrieval.evaluation.real.protocol import Protocol
from retrieval.metrics.intervals import compare, compare_splits, summarise, summarise_splits
from retrieval.metrics.measure import Measure

RULE = (
    "A result counts as touch only if it is evidence that the relief in the gel identifies the object: its main "
    "measure must be higher than that of each control, with the whole interval of the paired difference above 0. Two "
    "controls always apply: the same method on low-pass touches, and the order of capture as input instead of the "
    "touch. If touches are compared with touches, a third one applies: the no-contact frame as input."
)
CONTROL_NAMES = {
    "low_pass_differences": "the low-pass control",
    "order_differences": "the order of capture",
    "no_contact_differences": "the no-contact frame as input",
}
"""Key of a row's paired differences -> name of the control."""

MeasuresBySeed = Sequence[Mapping[str, Measure]]


@dataclass(frozen=True)
class Aggregation:
    """Aggregates measures over seeds, with intervals that resample objects, or over choices of test objects.

    Attributes:
        draws: Resamples of an interval.
        seed: Seed of the resamples.
        ratio: Number of test objects divided by the number of training objects, if the measures are from random
            choices of test objects; None if they are from training seeds.
    """

    draws: int
    seed: int
    ratio: float | None = None

    def summaries(self, by_seed: MeasuresBySeed) -> dict[str, Any]:
        """Return values with intervals, for measures that all seeds have."""
        found = {name: [one[name] for one in by_seed] for name in _shared(by_seed)}
        if self.ratio is not None:
            return {name: summarise_splits(measures, self.ratio) for name, measures in found.items()}
        return {name: summarise(measures, draws=self.draws, seed=self.seed) for name, measures in found.items()}

    def differences(self, a: MeasuresBySeed, b: MeasuresBySeed) -> dict[str, Any]:
        """Return paired differences `a` - `b`, by name."""
        names = [name for name in _shared(a) if name in _shared(b)]
        pairs = {name: ([one[name] for one in a], [one[name] for one in b]) for name in names}
        if self.ratio is not None:
            return {name: compare_splits(*pair, self.ratio) for name, pair in pairs.items()}
        return {name: compare(*pair, draws=self.draws, seed=self.seed) for name, pair in pairs.items()}


def _shared(by_seed: MeasuresBySeed) -> list[str]:
    return [name for name in by_seed[0] if all(name in one for one in by_seed)]


def row_entry(
    protocol: Protocol,
    touch: MeasuresBySeed,
    low_pass: MeasuresBySeed,
    order: MeasuresBySeed,
    aggregation: Aggregation,
    no_contact: MeasuresBySeed = (),
) -> dict[str, Any]:
    """Return the numbers of a row: measures, low-pass measures, paired differences from the controls, verdict.

    Args:
        protocol: The protocol.
        touch: Measures of the touches.
        low_pass: Measures of low-pass touches; empty for a trivial baseline, which has no verdict.
        order: Measures of the control "order of capture".
        aggregation: How measures are aggregated.
        no_contact: Measures with the no-contact frames as input, if the verdict uses this control.
    """
    measures = aggregation.summaries(touch)
    entry: dict[str, Any] = {"measures": measures, "low_pass": None, "verdict": None, **dict.fromkeys(CONTROL_NAMES)}
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
    protocol: Protocol, description: str, reason: str | None, by_seed: MeasuresBySeed, aggregation: Aggregation
) -> dict[str, Any]:
    """Return the numbers of a control, or the reason why there are none."""
    return {
        "description": description,
        "reason": reason,
        "measures": aggregation.summaries(by_seed) if by_seed else None,
    }


def verdict(summary: Mapping[str, Any], *differences: Mapping[str, Any]) -> dict[str, Any]:
    """Return whether a row's main measure counts as touch (see `RULE`), and the reason in words.

    Args:
        summary: The main measure.
        *differences: Paired differences from the controls, in the order of `CONTROL_NAMES`; the whole interval of each
            must be above 0.
    """
    counts_as_touch = all(one["low"] > 0 for one in differences)
    found = [_against(one, name) for one, name in zip(differences, CONTROL_NAMES.values(), strict=False)]
    words = f"{'counts' if counts_as_touch else 'does not count'} as touch: {'; '.join(found)}"
    above = summary["low"][0] > summary["chance"][0]
    return {"counts_as_touch": counts_as_touch, "above_chance": bool(above), "words": words}


def _against(difference: Mapping[str, Any], control: str) -> str:
    mean, low, high = (100 * difference[key] for key in ("difference", "low", "high"))
    points = f"{mean:+.1f} points [{low:+.1f}, {high:+.1f}]"
    if low > 0:
        return f"{points} over {control}"
    if high < 0:
        return f"{points} below {control}"
    return f"{points} against {control}, an interval that contains 0"
