"""From measures to results: values with intervals, paired differences from the controls, and the verdict."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType

from retrieval.data.dataset import Split
from retrieval.evaluation.inputs import INPUTS
from retrieval.evaluation.protocol import Protocol, RecordingFacts
from retrieval.evaluation.results import (
    Comparison,
    ControlResult,
    ProtocolResult,
    RecordingResult,
    RowResult,
    Summaries,
    Verdict,
)
from retrieval.metrics.intervals import Difference, Summary, compare, compare_splits, summarise, summarise_splits
from retrieval.metrics.measure import Measure

RULE = (
    "A result counts as touch only if it is evidence that the relief in the gel identifies the object: its main "
    "measure must be higher than that of each control, with the whole interval of the paired difference above 0. Two "
    "controls always apply: the same method on low-pass touches, and the order of capture as input instead of the "
    "touch. If touches are compared with touches, a third one applies: the no-contact frame as input."
)
CONTROL_NAMES = {
    "low_pass": "the low-pass control",
    "order": "the order of capture",
    "no_contact": "the no-contact frame as input",
}
"""Control of a verdict -> its name."""

MeasuresByName = Mapping[str, Sequence[Measure]]
"""Name -> the measure of each training seed, or of each choice of test objects."""


@dataclass(frozen=True)
class Aggregation:
    """Aggregates measures over seeds, with intervals that resample objects, or over choices of test objects.

    Attributes:
        seed: Seed of the resamples.
        ratio: Number of test objects divided by the number of training objects, if the measures are from random
            choices of test objects; None if they are from training seeds.
    """

    seed: int
    ratio: float | None = None

    def summaries(self, measures: MeasuresByName) -> Summaries:
        """Return values with intervals, by name."""
        return {
            name: summarise(each, seed=self.seed) if self.ratio is None else summarise_splits(each, self.ratio)
            for name, each in measures.items()
        }

    def differences(self, a: MeasuresByName, b: MeasuresByName) -> dict[str, Difference]:
        """Return paired differences `a` - `b`, by name."""
        return {
            name: compare(each, b[name], seed=self.seed)
            if self.ratio is None
            else compare_splits(each, b[name], self.ratio)
            for name, each in a.items()
            if name in b
        }


def protocol_result(
    protocol: Protocol,
    facts: RecordingFacts,
    folds: Iterable[Sequence[Split]],
    rows: Mapping[str, RowResult],
    measures: Mapping[tuple[str, str], MeasuresByName],
    compared: Iterable[tuple[str, str]],
    aggregation: Aggregation,
    reasons: Mapping[str, str] = MappingProxyType({}),
) -> ProtocolResult:
    """Return the results of a protocol.

    Args:
        protocol: The protocol.
        facts: The recording.
        folds: The splits of each seed.
        rows: The rows, without measures.
        measures: Measures by row and kind of inputs; the row of controls and ceilings is "".
        compared: Pairs of rows whose paired differences are stated.
        aggregation: How measures are aggregated.
        reasons: Why a control or a ceiling was not measured.
    """
    controls = {
        kind: ControlResult(
            INPUTS[kind],
            method,
            aggregation.summaries(measures["", kind]) if ("", kind) in measures else None,
            reasons.get(kind),
        )
        for kind, method in {**protocol.controls, **protocol.ceilings}.items()
    }
    differences = {(a, b): aggregation.differences(measures[a, "touch"], measures[b, "touch"]) for a, b in compared}
    return ProtocolResult(
        title=protocol.title,
        rule=protocol.rule,
        published_results=list(protocol.published_results),
        main=protocol.main,
        labels=[(name, metric.label) for name, metric in protocol.measures.items()],
        unit="choice" if protocol.choices else "sequence" if protocol.is_by_sequence else "object",
        recording=RecordingResult(
            protocol.data_set or facts.folder.resolve().name,
            facts.source,
            facts.digest,
            len(facts.names),
            len(facts.grasps),
        ),
        folds=[[asdict(split) for split in splits] for splits in folds],
        rows={name: _measured(protocol, name, row, measures, aggregation) for name, row in rows.items()},
        controls={kind: one for kind, one in controls.items() if kind not in protocol.ceilings},
        ceilings={kind: one for kind, one in controls.items() if kind in protocol.ceilings},
        comparisons=[
            Comparison(a, b, name, found[name])
            for name in protocol.control_measures or protocol.measures
            for (a, b), found in differences.items()
            if name in found
        ],
    )


def _measured(
    protocol: Protocol,
    name: str,
    row: RowResult,
    measures: Mapping[tuple[str, str], MeasuresByName],
    aggregation: Aggregation,
) -> RowResult:
    """Return a row with its measures, and if it has a low-pass control, with differences and verdict."""
    touch, main = measures[name, "touch"], protocol.main
    row = replace(row, measures=aggregation.summaries(touch))
    if (name, "low_pass") not in measures:
        return row
    controls = {"low_pass": name, "order": "", "no_contact": name}
    differences = {
        kind: aggregation.differences(touch, measures[control, kind])
        for kind, control in controls.items()
        if (control, kind) in measures
    }
    return replace(
        row,
        low_pass=aggregation.summaries(measures[name, "low_pass"]),
        differences=differences,
        verdict=verdict(row.measures[main], {kind: one[main] for kind, one in differences.items()}),
    )


def verdict(main: Summary, differences: Mapping[str, Difference]) -> Verdict:
    """Return whether a row's main measure counts as touch (see `RULE`).

    Args:
        main: The main measure.
        differences: Its paired differences from the controls, by their names in `CONTROL_NAMES`; the whole interval of
            each must be above 0.
    """
    return Verdict(all(one.low > 0 for one in differences.values()), main.low[0] > main.chance[0])
