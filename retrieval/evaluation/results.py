"""Results of an evaluation as data: results.json, written by `evaluate` and read by the report."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import msgspec

from _touch_retrieval.files import write_atomically
from retrieval.errors import BadInput
from retrieval.metrics.intervals import Difference, Summary
from retrieval.metrics.measure import Measure

M = TypeVar("M", Measure, Summary)


Summaries = dict[str, Summary]
"""Summaries by name of the measure."""


@dataclass(frozen=True)
class Verdict:
    """Whether the main measure of a row counts as touch (`retrieval.evaluation.aggregate.RULE`), with the reason."""

    counts_as_touch: bool
    above_chance: bool


@dataclass(frozen=True)
class PairThreshold:
    """The score above which a pair is classified as a match, with its source; or why there is none."""

    at: float | None
    source: str | None = None
    reason: str | None = None


@dataclass(frozen=True)
class Confusion:
    """An object, another one that ranked first for its touches, and the fraction of these touches."""

    object_id: str
    mistaken_for: str
    share: float


@dataclass(frozen=True)
class Rejection(Generic[M]):
    """Decisions that an object is not in the catalogue: measures, or their summaries.

    Attributes:
        auroc: Area under the ROC curve: how often the statistic of a row with its object in the gallery exceeds that of
            a row without; ties count 1/2.
        balanced_accuracy: Mean of true accept rate and true reject rate; a row is accepted if "one of these" is at
            least as likely as none, at even prior.
        roc: [false accept rate, true accept rate], from accepting none to accepting all.
    """

    auroc: M
    balanced_accuracy: M
    roc: list[list[float]]


@dataclass(frozen=True)
class Rate:
    """An error rate with its interval: null unless there are `objects_needed` objects, which is null without errors."""

    value: float | None
    low: float | None
    high: float | None
    objects_needed: int | None


@dataclass(frozen=True)
class VerificationRates:
    """Counts of objects and of sequences of grasps, equal error rate, false-reject rate by false-accept rate "0.01"."""

    objects: int
    sequences: int
    eer: Rate
    frr: dict[str, Rate]


@dataclass(frozen=True)
class Details:
    """Single objects and decisions of a method on one split, fitted with the first seed.

    Attributes:
        pair_threshold: The threshold of pair accuracy.
        per_object: Mean top-1 accuracy of 5 of each object: "test_candidates" among test objects, "all_candidates".
        confusions: The most frequent ones.
        posterior: That of single touches; None with too few validation objects.
        reliability: "k5", "k10" -> {"ece", "bins"}; empty without a posterior.
        reject: None with too few objects.
        verification: Impostors ("random", "similar") -> number of grasps -> rates; None with too few objects, and for
            methods other than late fusion.
    """

    pair_threshold: PairThreshold
    per_object: dict[str, dict[str, float]]
    confusions: list[Confusion]
    posterior: dict[str, Any] | None
    reliability: dict[str, Any]
    reject: Rejection[Summary] | None = None
    verification: dict[str, dict[str, VerificationRates]] | None = None


@dataclass(frozen=True)
class RowResult:
    """A row of the table: a method on towers, or a checkpoint.

    Attributes:
        method: Name of the method.
        model: Digest of the checkpoint that scores as it is, or whose towers are used; None for other towers.
        best_params: Parameters that the method selected, by seed and fold.
        measures: Measures of the touches.
        low_pass: Measures with low-pass touches; None without this control of the row.
        differences: Control ("low_pass", "order", "no_contact") -> measure -> touch minus control.
        verdict: None for rows without controls of their own.
        details: None for protocols of several folds.
    """

    method: str
    model: str | None
    best_params: list[list[dict[str, Any]]]
    measures: Summaries = field(default_factory=dict)
    low_pass: Summaries | None = None
    differences: dict[str, dict[str, Difference]] = field(default_factory=dict)
    verdict: Verdict | None = None
    details: Details | None = None


@dataclass(frozen=True)
class ControlResult:
    """A control or a ceiling: one method on other inputs; or the reason why it was not measured."""

    description: str
    method: str
    measures: Summaries | None
    reason: str | None = None


@dataclass(frozen=True)
class Comparison:
    """A paired difference between two rows: `a` minus `b`."""

    a: str
    b: str
    measure: str
    difference: Difference


@dataclass(frozen=True)
class RecordingResult:
    """The evaluated recording: folder name, source, digest of the grasps, and counts."""

    name: str
    source: str
    digest: str
    objects: int
    grasps: int


@dataclass(frozen=True)
class ProtocolResult:
    """Results of one protocol, described in `rule`.

    Attributes:
        main: The measure that decides.
        labels: Measure and label, in the order of tables.
        unit: What intervals resample: "object" or "sequence"; or "choice", if they cover choices of test objects.
        folds: The splits of each seed; one list if all seeds have the same splits.
        rows: Rows by name, in the order of tables.
        controls: Controls by name.
        ceilings: Methods within one modality.
        comparisons: Paired differences between rows.
    """

    title: str
    rule: str
    published_results: list[str]
    main: str
    labels: list[tuple[str, str]]
    unit: str
    recording: RecordingResult
    folds: list[list[dict[str, Any]]]
    rows: dict[str, RowResult]
    controls: dict[str, ControlResult]
    ceilings: dict[str, ControlResult]
    comparisons: list[Comparison]


@dataclass(frozen=True)
class Setting:
    """Settings: name and content of the configuration, digest of `--model`, compared digests or configurations."""

    preset: str
    config: dict[str, Any]
    model: str | None
    compared: dict[str, Any]
    seeds: list[int]


@dataclass(frozen=True)
class Results:
    """All results of an evaluation: the content of results.json, which has no times and no paths.

    Attributes:
        setting: The settings.
        protocols: Protocols by name.
        skipped: Protocol -> the reason why it was not run.
        software: Version of the writer.
        schema_version: The only one that is read.
    """

    setting: Setting
    protocols: dict[str, ProtocolResult]
    skipped: dict[str, str]
    software: str
    schema_version: Literal[6] = 6


def write_results(path: Path, results: Results) -> None:
    """Write results.json. Equal results give equal bytes."""
    write_atomically(path, msgspec.json.format(msgspec.json.encode(results), indent=1) + b"\n")


def read_results(path: Path) -> Results:
    """Read a file that `write_results` wrote.

    Raises:
        BadInput: The file cannot be read, or another version wrote it.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=Results)
    except (OSError, msgspec.MsgspecError) as error:
        raise BadInput(
            f"{path} must contain the results of an evaluation by this version ({error}). Run `retrieve evaluate`."
        ) from error
