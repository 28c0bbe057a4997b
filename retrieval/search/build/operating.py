"""The operating point of an index: the kind that finds candidates, and the number of candidates to rerank.

It is measured on the catalogue, with touches of validation objects that the checkpoint stores for this. The exhaustive
top-1 of a touch is the photo that the fusion head ranks first if it scores every photo ("exact" search, in contrast,
is exact nearest-neighbour search by embedding). The agreement@k with exhaustive search ("recall" below) is the fraction
of touches whose exhaustive top-1 is among the k candidates.

    no bound       use exact search with the smallest k of `candidate_steps` that has a recall of 0.99
    min_recall     try exact search, then approximate kinds. Take the first point with this recall whose search takes
                   no longer than its reranking. If there is none, take the fastest point with this recall
    max_ms         try exact search, then approximate kinds. Take the first point with a recall of 0.99 within the
                   time. If there is none, take the point with the highest recall within the time. If no point is
                   within the time, take the fastest point with a recall of 0.99
    both           try exact search, then approximate kinds. Take the first point with this recall within the time. If
                   there is none, take the fastest point with this recall

A required kind is the only choice; its search may take longer than its reranking. The cost of exhaustive search grows
with the catalogue, so larger catalogues use fewer touches. A measurement is reused until a tenth of the photos has
changed.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from indexes import KINDS, load_kind
from indexes.kinds.scores import Floats, Slots
from indexes.kinds.vector_index import Parameters, VectorIndex
from indexes.store.manifest import Manifest
from indexes.store.tables import Tables
from retrieval.errors import BadInput
from retrieval.metrics.k_way import binomial_interval
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.stored_partials import StoredPartials
from retrieval.search.build.measuring import (
    SHORT_LADDER,
    ExhaustiveBench,
    NeighbourBench,
    SearchBench,
    SearchPoint,
    can_measure,
    candidate_steps,
)

TARGET = 0.99
"""Default of the agreement@k that the chosen k candidates must reach."""

APPROXIMATE_FACTOR = 4
"""Under a bound, approximate kinds are tried with at most this many times the candidates of exact search."""

MAX_CHANGED_FRACTION = 0.10
"""Fraction of a catalogue that may change before its operating point is measured again."""


@dataclass(frozen=True)
class SearchRequirements:
    """A user's requirements of candidate search; None means no requirement.

    Attributes:
        kind: Name of a kind of index.
        min_recall: Smallest agreement@k of the chosen k candidates.
        max_ms: Longest candidate search and reranking of one touch, in milliseconds, with the index open.

    Raises:
        BadInput: A bound is out of range.
        ParameterError: No kind has this name.
    """

    kind: str | None = None
    min_recall: float | None = None
    max_ms: float | None = None

    def __post_init__(self) -> None:
        if self.kind is not None:
            load_kind(self.kind)
        if self.min_recall is not None and not 0 < self.min_recall <= 1:
            raise BadInput(f"the minimum recall must be above 0 and at most 1; got {self.min_recall}")
        if self.max_ms is not None and not self.max_ms > 0:
            raise BadInput(f"the time limit of a search must be more than 0 ms; got {self.max_ms}")

    @classmethod
    def of(
        cls, kind: str | type[VectorIndex] | None, min_recall: float | None, max_ms: float | None
    ) -> "SearchRequirements":
        """Return the requirements.

        Args:
            kind: A name, "module:Class" or a class; None for no requirement.
            min_recall: As the attribute.
            max_ms: As the attribute.

        Raises:
            BadInput: A bound is out of range.
            ParameterError: No kind has this name.
        """
        return cls(None if kind is None else KINDS.name_of(kind), min_recall, max_ms)

    @property
    def target(self) -> float:
        """Agreement@k that the point must reach."""
        return TARGET if self.min_recall is None else self.min_recall

    @property
    def is_bounded(self) -> bool:
        """Whether the user set a bound for recall or time."""
        return self.min_recall is not None or self.max_ms is not None


@dataclass(frozen=True)
class OperatingPoint:
    """A chosen kind of index with its parameters, the reason as a sentence, and the manifest's "candidates" or None."""

    kind: str
    parameters: Parameters
    reason: str
    candidates: dict[str, Any] | None


def choose_operating_point(
    checkpoint: Checkpoint,
    tables: Tables,
    requirements: SearchRequirements,
    previous: Manifest | None,
    changed: int,
    *,
    quiet: bool = True,
) -> OperatingPoint:
    """Choose the kind of index and the number of candidates, by measurement if the checkpoint stores touches.

    Args:
        checkpoint: The model, with the touches that it stores to measure with.
        tables: Tables of the new generation.
        requirements: The user's requirements.
        previous: Manifest of the previous generation, whose measurement may be reused.
        changed: Number of photos that changed since.
        quiet: Show no progress.
    """
    photos = len(tables.slots)
    record = previous and carry_over(previous.about.get("candidates"), requirements, photos, changed)
    if previous is not None and record:
        parameters = load_kind(previous.kind).parameters_from(previous.requested)
        return OperatingPoint(previous.kind, parameters, operating_point_sentence(record, photos), record)
    if not checkpoint.config.has_embeddings or not needs_measurement(photos, requirements):
        kind, candidates = requirements.kind or "flat", exhaustive_record(photos, requirements)
        reason = operating_point_sentence(candidates, photos)
        return OperatingPoint(kind, load_kind(kind).parameters_type(), reason, candidates)
    if not can_measure(checkpoint):
        return choose_by_neighbours(tables.vectors, tables.slots, requirements)
    partials = StoredPartials(tables.arrays)
    bench = ExhaustiveBench(checkpoint, tables.vectors, tables.slots, partials, quiet=quiet)
    return choose_by_agreement(bench, requirements)


def needs_measurement(photos: int, requirements: SearchRequirements) -> bool:
    """Whether the choice needs a measurement. A small catalogue needs none, unless there is a time bound."""
    return len(candidate_steps(photos)) > 1 or requirements.max_ms is not None


def choose_by_agreement(bench: SearchBench, requirements: SearchRequirements) -> OperatingPoint:
    """Choose the operating point by measured agreement with exhaustive search."""
    point = _choose_point(bench, requirements)
    candidates = _record(point, requirements, bench)
    return OperatingPoint(point.kind, point.parameters, operating_point_sentence(candidates, bench.count), candidates)


def choose_by_neighbours(vectors: Floats, slots: Slots, requirements: SearchRequirements) -> OperatingPoint:
    """Choose only the kind, by recall of nearest neighbours, for a checkpoint that stores no touches.

    Without a time bound, or with a required kind, nothing is measured.

    Args:
        vectors: Unit embeddings (S, d) float32.
        slots: Row of `vectors` of each photo (N,).
        requirements: The user's requirements.
    """
    why = "The checkpoint stores no touches to measure candidates with, so recall is that of nearest neighbours."
    if requirements.kind is not None or requirements.max_ms is None:
        kind = requirements.kind or "flat"
        reason = "Exact search: there is no time bound." if requirements.kind is None else "The user chose this kind."
        return OperatingPoint(kind, load_kind(kind).parameters_type(), f"{reason} {why}", None)
    point = _choose_point(NeighbourBench(vectors[np.unique(slots)]), requirements)
    found = f"A search takes {point.ms:.3g} ms and finds {point.found} of {point.queries} neighbours."
    unmet = _unmet_requirements(point.recall, point.ms, asdict(requirements))
    return OperatingPoint(point.kind, point.parameters, f"{found}{unmet} {why}", None)


def _choose_point(bench: SearchBench, requirements: SearchRequirements) -> SearchPoint:
    """Return the first sufficient point; if there is none, the best one."""
    tried: list[SearchPoint] = []
    for point in _points(bench, requirements):
        if _is_sufficient(point, requirements):
            return point
        tried.append(point)
    return _best_point([*tried, *_points_within_time(bench, requirements, tried)], requirements)


def _points(bench: SearchBench, requirements: SearchRequirements) -> Iterator[SearchPoint]:
    """Yield points of exact search with more and more candidates until one has the recall, then of approximate kinds.

    Approximate kinds start with the number of candidates of the last exact point. If an approximate kind is required,
    exact search is measured only to find this number, and its points are not yielded. The last point of the required
    kind reranks all photos.
    """
    approximate = None if requirements.kind is None or load_kind(requirements.kind).exact else requirements.kind
    exact = bench.index_of_kind("flat" if requirements.kind is None or approximate else requirements.kind)
    for point in (bench.point(exact, k) for k in bench.steps):
        if not approximate:
            yield point
        if point.recall >= requirements.target:
            break
    others = (
        [approximate]
        if approximate
        else bench.kinds_to_try()
        if requirements.kind is None and requirements.is_bounded
        else []
    )
    for kind in others if point.k < bench.count else ():
        yield from _kind_points(bench, bench.index_of_kind(kind), requirements, minimum=point.k)
    if approximate:
        yield bench.point(bench.index_of_kind(approximate), bench.count)


def _kind_points(
    bench: SearchBench, index: VectorIndex, requirements: SearchRequirements, minimum: int
) -> Iterator[SearchPoint]:
    """Yield points with at least `minimum` candidates; search settings vary only if there is a bound to meet."""
    steps = [k for k in bench.steps if k >= minimum]
    if not requirements.is_bounded:
        yield from (bench.point(index, k) for k in steps)
        return
    for variant in index.search_variants():
        yield from (bench.point(variant, k) for k in steps if k <= APPROXIMATE_FACTOR * minimum)


def _is_sufficient(point: SearchPoint, requirements: SearchRequirements) -> bool:
    """Whether the search for a point can stop here: the point has the recall, and also fits the bounds.

    With a time bound, search and reranking are within it. With only a minimum recall and no required kind, the search
    takes no longer than reranking.
    """
    if point.recall < requirements.target:
        return False
    if requirements.max_ms is not None:
        return point.ms <= requirements.max_ms
    return requirements.min_recall is None or requirements.kind is not None or point.search_ms <= point.rerank_ms


def _points_within_time(
    bench: SearchBench, requirements: SearchRequirements, tried: Sequence[SearchPoint]
) -> Iterator[SearchPoint]:
    """For each tried kind and search setting, yield the point with the most candidates that fits the time.

    It has fewer candidates than the smallest step. Only if the user set a time bound and no minimum recall.
    """
    if requirements.max_ms is None or requirements.min_recall is not None:
        return
    for kind in dict.fromkeys(point.kind for point in tried):
        for index in bench.index_of_kind(kind).search_variants():
            fewer = (k for k in SHORT_LADDER if k < bench.steps[0])
            k = next((k for k in fewer if sum(bench.times(index, k)) <= requirements.max_ms), None)
            if k is not None:
                yield bench.point(index, k)


def _best_point(points: Sequence[SearchPoint], requirements: SearchRequirements) -> SearchPoint:
    """Return the best of several insufficient points.

    With a time bound only, this is the point with the highest recall within the time. Otherwise, or if no point is
    within the time, it is the fastest point with the recall.
    """
    quick = [point for point in points if requirements.max_ms is not None and point.ms <= requirements.max_ms]
    if requirements.min_recall is None and quick:
        return max(quick, key=lambda point: (point.recall, -point.ms))
    good = [point for point in points if point.recall >= requirements.target]
    return min(good, key=lambda point: point.ms)


def _record(point: SearchPoint, requirements: SearchRequirements, bench: SearchBench) -> dict[str, Any]:
    low, high = binomial_interval(point.found, point.queries)
    return {
        "k": point.k,
        "top1_agreement": point.recall,
        "interval": [low, high],
        "queries": point.queries,
        "ms": point.ms,
        "exhaustive_ms": bench.exhaustive_ms,
        "kind": point.kind,
        "parameters": asdict(point.parameters),
        "requirements": asdict(requirements),
        "photos": bench.count,
        "changed": 0,
    }


def exhaustive_record(photos: int, requirements: SearchRequirements) -> dict[str, Any]:
    """Return the manifest's "candidates" if all photos are scored without a measurement."""
    return {
        "k": photos,
        "top1_agreement": 1.0,
        "queries": 0,
        "requirements": asdict(requirements),
        "photos": photos,
        "changed": 0,
    }


def carry_over(
    previous: Mapping[str, Any] | None, requirements: SearchRequirements, photos: int, changed: int
) -> dict[str, Any] | None:
    """Return the updated record of an earlier measurement; None if a new measurement is necessary.

    A measurement is reused if the requirements are equal and at most `MAX_CHANGED_FRACTION` of the photos changed.

    Args:
        previous: The manifest's "candidates" of the previous generation.
        requirements: The user's requirements.
        photos: Number of photos now.
        changed: Number of photos that this build changed.
    """
    if not previous or not previous.get("queries") or previous["requirements"] != asdict(requirements):
        return None
    total = previous["changed"] + changed
    if total > MAX_CHANGED_FRACTION * previous["photos"]:
        return None
    k = previous["k"]  # may exceed the number of photos, so that a catalogue that shrank may grow again
    return {**previous, "changed": total, "k": max(k, photos) if k >= previous["photos"] else k}


def operating_point_sentence(candidates: Mapping[str, Any], photos: int) -> str:
    """Return a record as text: the candidates, their agreement with exhaustive search, and unmet requirements.

    Args:
        candidates: The record.
        photos: Number of photos now; a reused record has the number of photos that were measured.
    """
    k = candidates["k"]
    if not candidates["queries"]:
        return f"The fusion head scores all {photos} photos."
    low, high = candidates["interval"]
    found = round(candidates["top1_agreement"] * candidates["queries"])
    scored = "scores every photo" if k >= photos else f"reranks the best {k} of {photos} photos"
    text = (
        f"The fusion head {scored}. The candidates contain the exhaustive top-1 for {found} of {candidates['queries']} "
        f"validation touches (95 % interval {low:.3f} to {high:.3f}). Search and reranking take "
        f"{candidates['ms']:.3g} ms, scoring all photos {candidates['exhaustive_ms']:.3g} ms."
    )
    return text + _unmet_requirements(candidates["top1_agreement"], candidates["ms"], candidates["requirements"])


def _unmet_requirements(recall: float, ms: float, requirements: Mapping[str, Any]) -> str:
    target = TARGET if requirements["min_recall"] is None else requirements["min_recall"]
    unmet = []
    if recall < target:
        unmet.append(f"does not reach a recall of {target:g}")
    if requirements["max_ms"] is not None and ms > requirements["max_ms"]:
        unmet.append(f"is slower than {requirements['max_ms']:g} ms")
    return f" This setting {' and '.join(unmet)}. No measured setting meets all requirements." if unmet else ""
