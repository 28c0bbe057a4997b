"""Which kind of index meets a latency budget: measured on this machine, on the vectors themselves."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from indexes import load_kind
from indexes.errors import ParameterError
from indexes.kinds.base import Parameters, VectorIndex
from indexes.kinds.measure import Clock, query_ms, recall_against_exact, sample_queries
from indexes.kinds.scores import Floats
from indexes.store.plan import first_of_equals

LADDERS: dict[str, tuple[str, tuple[int, ...]]] = {
    "hnsw": ("ef_search", (16, 32, 64, 128, 256, 512)),
    "ivf_flat": ("probes", (1, 4, 16, 64, 256)),
    "ivf_sq8": ("probes", (1, 4, 16, 64, 256)),
    "ivf_pq": ("probes", (1, 4, 16, 64, 256)),
}
"""Approximate kind -> the setting that trades time for recall, and the values to try, fastest first."""

MEASURED_QUERIES = 64


@dataclass(frozen=True)
class OperatingPoint:
    """One way to search: median milliseconds of a single query, and recall at k against the exact search."""

    kind: str
    parameters: Parameters
    ms: float
    recall: float


@dataclass(frozen=True)
class Choice:
    """The kind to build and why; milliseconds are None where nothing had to be measured."""

    kind: str
    parameters: Parameters
    measured_ms: float | None
    exact_ms: float | None
    recall: float
    reason: str


def require_buildable(kind: str, count: int, dim: int) -> None:
    """Refuse, with `ParameterError`, a kind that is unknown or cannot be built over so many vectors of that size."""
    chosen = load_kind(kind)
    chosen._resolve(chosen.parameters_type(), count, dim)


def operating_points(
    vectors: Floats,
    kinds: Sequence[str] = ("flat", "hnsw", "ivf_flat"),
    *,
    k: int = 10,
    queries: Floats | None = None,
    seed: int = 0,
    threads: int | None = 1,
    clock: Clock = time.perf_counter,
) -> Iterator[OperatingPoint]:
    """Every step of every kind's ladder over distinct unit vectors (M, d), each when it is asked for.

    `queries` (Q, d) are what to measure with; None draws them near the vectors (see `sample_queries`).
    A kind is built only when its first point is asked for.
    """
    asked = sample_queries(vectors, MEASURED_QUERIES, seed=seed) if queries is None else queries
    for kind in kinds:
        built = load_kind(kind).build(vectors, seed=seed, threads=threads)
        for index in ladder(built):
            recall = 1.0 if index.exact else recall_against_exact(index, asked, k)
            yield OperatingPoint(kind, index.parameters, query_ms(index, asked, k, clock=clock), recall)


def choose_kind(
    vectors: Floats,
    budget_ms: float | None = None,
    min_recall: float = 0.99,
    *,
    k: int = 10,
    queries: Floats | None = None,
    seed: int = 0,
    threads: int | None = 1,
    clock: Clock = time.perf_counter,
) -> Choice:
    """The kind for unit vectors (M, d) and a budget in milliseconds for one query's search.

    Exact search (`flat`) is kept while it meets the budget, and nothing is measured where there is none.
    Otherwise the first point of `hnsw`, then of `ivf_flat`, that meets the budget with at least `min_recall`
    is taken; where none does, the fastest of that recall, if faster than exact. `reason` is one sentence.

    >>> import numpy as np
    >>> indexes.choose_kind(np.eye(3, dtype=np.float32)).reason
    'Exact search: no time budget was asked for.'
    """
    flat = load_kind("flat").parameters_type()
    if budget_ms is None:
        return Choice("flat", flat, None, None, 1.0, "Exact search: no time budget was asked for.")
    if not budget_ms > 0 or not 0 < min_recall <= 1:
        raise ParameterError(
            f"the budget must be above 0 ms and the recall in (0, 1]; got {budget_ms!r} and {min_recall!r}"
        )
    distinct = vectors[sorted(set(first_of_equals(vectors).tolist()))]
    points = operating_points(distinct, k=k, queries=queries, seed=seed, threads=threads, clock=clock)
    exact = next(points)
    if exact.ms <= budget_ms:
        reason = f"Exact search: it takes {exact.ms:.3g} ms, within the budget of {budget_ms:g} ms."
        return Choice("flat", flat, exact.ms, exact.ms, 1.0, reason)
    good: list[OperatingPoint] = []
    for point in points:
        if point.recall >= min_recall and point.ms < exact.ms:
            good.append(point)
            if point.ms <= budget_ms:
                break
    taken = min(good, key=lambda point: point.ms, default=exact)
    return _said(taken, exact, budget_ms, min_recall, k)


def _said(taken: OperatingPoint, exact: OperatingPoint, budget_ms: float, min_recall: float, k: int) -> Choice:
    over = f"takes {exact.ms:.3g} ms, over the budget of {budget_ms:g} ms"
    if taken is exact:
        reason = f"Exact search: it {over}, but nothing faster reaches a recall@{k} of {min_recall:g}."
    else:
        met = "" if taken.ms <= budget_ms else ", over the budget too but the fastest"
        this = f"this takes {taken.ms:.3g} ms{met}"
        recall = f"a measured recall@{k} of {taken.recall:.3f}"
        reason = f"{taken.kind}: exact search {over}; {this}, with {recall}."
    return Choice(taken.kind, taken.parameters, taken.ms, exact.ms, taken.recall, reason)


def ladder(built: VectorIndex) -> Iterator[VectorIndex]:
    """The same structure with each value of its kind's ladder, fastest first; one without a ladder as it is."""
    if built.kind not in LADDERS:
        yield built
        return
    setting, values = LADDERS[built.kind]
    for value in values:
        yield built.tuned(**{setting: value})
