"""The operating point of an index: which kind finds the candidates, and how many of them the classifier judges.

It is measured on the catalogue itself, with touches of validation objects that the checkpoint keeps for it. The winner
of a touch is the photo that the classifier ranks first when it judges every one; the winner recall at k is the share of
touches whose winner is among the k candidates.

    neither bound asked for    exact search, and the least k of a ladder with a winner recall of 0.99
    min_recall                 the least k with that recall; approximate kinds are tried where exact search takes
                               longer than judging its candidates, and the fastest point is taken
    max_ms                     the same if search and judging take no longer; else what approximate kind does; else
                               the highest recall within the time, or where nothing is, the fastest with the recall
    both                       recall and time, or where nothing has both, the fastest with the recall

What must be judged to know the winners grows with the catalogue: fewer touches are asked then, and what was measured
stands until a tenth of the photos has changed.
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
"""Winner recall where none is asked for."""

APPROXIMATE_FACTOR = 4
"""How many times more candidates an approximate kind may take than exact search needs."""

MAX_CHANGED_FRACTION = 0.10
"""Share of a catalogue that may change before its operating point is measured again."""


@dataclass(frozen=True)
class SearchRequirements:
    """What a user requires of candidate search; None leaves it open.

    Args:
        kind: Name of a kind of index.
        min_recall: Least winner recall.
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
            raise BadInput(f"the least winner recall must lie above 0 and be 1 at most; got {self.min_recall}")
        if self.max_ms is not None and not self.max_ms > 0:
            raise BadInput(f"the longest search must be above 0 ms; got {self.max_ms}")

    @classmethod
    def of(
        cls, kind: str | type[VectorIndex] | None, min_recall: float | None, max_ms: float | None
    ) -> "SearchRequirements":
        """Return the requirements; `kind` is a name, "module:Class" or a class. Raises as the class does."""
        return cls(None if kind is None else KINDS.name_of(kind), min_recall, max_ms)

    @property
    def target(self) -> float:
        """The winner recall to reach."""
        return TARGET if self.min_recall is None else self.min_recall

    @property
    def is_bounded(self) -> bool:
        """Whether the user set a bound for recall or time."""
        return self.min_recall is not None or self.max_ms is not None


@dataclass(frozen=True)
class OperatingPoint:
    """The index to build, the reason in a sentence, and the manifest's "candidates" (None: nothing)."""

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
    """Choose the kind of index and the number of candidates, measured where there is something to measure with.

    Args:
        checkpoint: The model, with the touches that it stores to measure with.
        tables: Everything that the index will hold.
        asked: The user's requirements.
        previous: Manifest of the generation before, whose measurement may still hold.
        changed: Number of photos that changed since.
        quiet: Show no progress.
    """
    photos = len(tables.slots)
    again = previous and carry_over(previous.about.get("candidates"), requirements, photos, changed)
    if previous is not None and again:
        parameters = load_kind(previous.kind).parameters_from(previous.requested)
        return OperatingPoint(previous.kind, parameters, operating_point_sentence(again), again)
    if not checkpoint.config.has_embeddings or not needs_measurement(photos, requirements):
        kind, candidates = requirements.kind or "flat", exhaustive_record(photos, requirements)
        return OperatingPoint(kind, load_kind(kind).parameters_type(), operating_point_sentence(candidates), candidates)
    if not can_measure(checkpoint):
        return choose_by_neighbours(tables.vectors, tables.slots, requirements)
    return choose_by_agreement(
        ExhaustiveBench(checkpoint, tables.vectors, tables.slots, tables.arrays["partials"], quiet=quiet), requirements
    )


def needs_measurement(photos: int, requirements: SearchRequirements) -> bool:
    """Whether the choice needs a measurement: of few photos all are scored, unless that may be too slow."""
    return len(candidate_steps(photos)) > 1 or requirements.max_ms is not None


def choose_by_agreement(bench: SearchBench, requirements: SearchRequirements) -> OperatingPoint:
    """The operating point for what was asked, measured on the bench by winners."""
    taken = _choose_point(bench, requirements)
    candidates = _record(taken, requirements, bench)
    return OperatingPoint(taken.kind, taken.parameters, operating_point_sentence(candidates), candidates)


def choose_by_neighbours(vectors: Floats, slots: Slots, requirements: SearchRequirements) -> OperatingPoint:
    """The kind alone, for vectors (S, d) and the slots (N,) of the photos, where the checkpoint keeps no touches to
    find winners of. Without a bound on the time nothing is measured.
    """
    why = "The checkpoint keeps no touches to measure candidates with, so recall is that of nearest neighbours."
    if requirements.kind is not None or requirements.max_ms is None:
        kind = requirements.kind or "flat"
        said = "Exact search: no time budget was asked for." if requirements.kind is None else "It was asked for."
        return OperatingPoint(kind, load_kind(kind).parameters_type(), f"{said} {why}", None)
    taken = _choose_point(NeighbourBench(vectors[np.unique(slots)]), requirements)
    found = f"A search takes {taken.ms:.3g} ms and finds {taken.found} of {taken.queries} neighbours."
    missed = _unmet_requirements(taken.recall, taken.ms, asdict(requirements))
    return OperatingPoint(taken.kind, taken.parameters, f"{found}{missed} {why}", None)


def _choose_point(bench: SearchBench, requirements: SearchRequirements) -> SearchPoint:
    """The first point that is good enough; where none is, the nearest."""
    tried: list[SearchPoint] = []
    for point in _points(bench, requirements):
        if _is_sufficient(point, requirements):
            return point
        tried.append(point)
    return _best_point([*tried, *_points_within_time(bench, requirements, tried)], requirements)


def _points(bench: SearchBench, requirements: SearchRequirements) -> Iterator[SearchPoint]:
    """Exact search with more and more candidates until the recall is there; then the approximate kinds, if any is to
    be tried, with as many candidates and more.
    """
    approximate = None if requirements.kind is None or load_kind(requirements.kind).exact else requirements.kind
    exact = bench.built("flat" if requirements.kind is None or approximate else requirements.kind)
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
        yield from _kind_points(bench, bench.built(kind), requirements, least=point.k)
    if approximate:
        yield bench.point(bench.built(approximate), bench.count)


def _kind_points(
    bench: SearchBench, built: VectorIndex, requirements: SearchRequirements, least: int
) -> Iterator[SearchPoint]:
    """Settings are tried only where there is a bound to meet; else the kind's own are taken."""
    steps = [k for k in bench.steps if k >= least]
    if not requirements.is_bounded:
        yield from (bench.point(built, k) for k in steps)
        return
    for index in built.search_variants():
        yield from (bench.point(index, k) for k in steps if k <= APPROXIMATE_FACTOR * least)


def _is_sufficient(point: SearchPoint, requirements: SearchRequirements) -> bool:
    """Whether no further point need be tried: this one has the recall and is within the time; where no time was asked
    for, its search takes no longer than its judging.
    """
    if point.recall < requirements.target:
        return False
    if requirements.max_ms is not None:
        return point.ms <= requirements.max_ms
    return requirements.min_recall is None or requirements.kind is not None or point.search_ms <= point.rerank_ms


def _points_within_time(
    bench: SearchBench, requirements: SearchRequirements, tried: Sequence[SearchPoint]
) -> Iterator[SearchPoint]:
    """Points with fewer candidates than the recall needs, for a user who asked for a short time and nothing else."""
    if requirements.max_ms is None or requirements.min_recall is not None:
        return
    for kind in dict.fromkeys(point.kind for point in tried):
        for index in bench.built(kind).search_variants():
            fewer = (k for k in SHORT_LADDER if k < bench.steps[0])
            k = next((k for k in fewer if sum(bench.times(index, k)) <= requirements.max_ms), None)
            if k is not None:
                yield bench.point(index, k)


def _best_point(points: Sequence[SearchPoint], requirements: SearchRequirements) -> SearchPoint:
    """The point to take where none was good enough. Where only a time was asked for: the highest recall within that
    time. Else, and where nothing is within it: the fastest point with the recall.
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
    """What the manifest says of a catalogue so small that every photo is judged, unmeasured."""
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
    """The record of what was measured before, brought up to date, where the same was asked for and too few of `photos`
    have changed since to measure again; else None. changed: how many photos this build changed.
    """
    if not previous or not previous.get("queries") or previous["requirements"] != asdict(requirements):
        return None
    total = previous["changed"] + changed
    if total > MAX_CHANGED_FRACTION * previous["photos"]:
        return None
    every = previous["k"] >= previous["photos"]
    return {**previous, "changed": total, "k": photos if every else min(previous["k"], photos)}


def operating_point_sentence(candidates: Mapping[str, Any]) -> str:
    """A record in words: what is judged, what of the winners that finds, and whether it is what was asked for."""
    k, photos = candidates["k"], candidates["photos"]
    if not candidates["queries"]:
        return f"The classifier judges all {photos} photos."
    low, high = candidates["interval"]
    found = round(candidates["top1_agreement"] * candidates["queries"])
    judged = "every photo" if k >= photos else f"the best {k} of {photos} photos"
    text = (
        f"The classifier judges {judged}: these hold its winner for {found} of {candidates['queries']} validation "
        f"touches (95 % interval {low:.3f} to {high:.3f}), in {candidates['ms']:.3g} ms against "
        f"{candidates['exhaustive_ms']:.3g} ms for all."
    )
    return text + _unmet_requirements(candidates["top1_agreement"], candidates["ms"], candidates["requirements"])


def _unmet_requirements(recall: float, ms: float, requirements: Mapping[str, Any]) -> str:
    target = TARGET if requirements["min_recall"] is None else requirements["min_recall"]
    missed = []
    if recall < target:
        missed.append(f"a recall of {target:g}")
    if requirements["max_ms"] is not None and ms > requirements["max_ms"]:
        missed.append(f"{requirements['max_ms']:g} ms")
    return f" Nothing measured here reaches {' and '.join(missed)}; this is the nearest." if missed else ""
