"""Number of reranked candidates: miss rate of the exhaustive top-1 against the time of a query."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import NDArray

import indexes
from indexes.kinds.vector_index import VectorIndex
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, miss_rate_point
from retrieval.frontier.sample import Array, Sample
from retrieval.search.build.candidates import EXHAUSTIVE_LIMIT, TARGET, candidate_steps

FEW = (10, 25, 50, 100, 250)
"""Numbers of candidates below the first one that `build-index` tries."""

TOLERANCE = 100 * (1 - TARGET)
"""Default tolerance of `build-index`: percent of exhaustive top-1 photos that the candidates may miss."""


def candidates(sample: Sample) -> ApproximationResult:
    """Measure numbers of candidates k: exact search by each embedding of the model, then reranking."""
    if not sample.queries.keys() - {"partial"}:
        return ApproximationResult(
            "Candidates", "", skipped="this model has no trained embeddings and reranks every photo"
        )
    return ApproximationResult(
        "Candidates",
        "The fusion head reranks only the k photos nearest in embedding. The reference reranks every photo. The "
        "exhaustive top-1 is the photo that the reference ranks first.",
        (_missed_top1_panel(sample), _lost_top1_panel(sample)),
    )


def _missed_top1_panel(sample: Sample) -> Panel:
    photos, points, works = sample.catalogue, list[Tradeoff](), list[Callable[[], object]]()
    count, default = len(photos.partials), default_k(sample)
    for name, embeddings in photos.embeddings.items():
        found = ranks(sample.queries[name], embeddings, sample.exhaustive_top1)
        index = indexes.build(embeddings, threads=1)
        for k in (*FEW, *candidate_steps(count)[:-1]):
            points.append(miss_rate_point(name, f"k = {k:,}", found >= k, k == default and is_used(sample, name)))
            works.append(_query_work(sample, index, sample.queries, name, photos.partials, k))
    points.append(miss_rate_point("no candidates", "all", sample.exhaustive_top1 < 0, default == count))
    works.append(partial(sample.logits, sample.queries["partial"][0], photos.partials))
    points = list(time_points(points, works, sample.scale.repeats))
    return _panel(f"missed exhaustive top-1, {count:,} blended photos", points, len(sample.exhaustive_top1))


def _panel(title: str, points: Sequence[Tradeoff], queries: int) -> Panel:
    return Panel(
        title=title,
        time="search and rerank of one query, one thread",
        unit="% of queries",
        reference="every photo reranked",
        tolerance=round(TOLERANCE, 6),
        points=tuple(points),
        resolution=100 / queries,
    )


def _query_work(
    sample: Sample, index: VectorIndex, queries: Mapping[str, Array], name: str, partials: NDArray[Any], k: int
) -> Callable[[], object]:
    """Return a function that searches and reranks one touch after the other."""
    touches = cycle(zip(queries["partial"], queries[name], strict=True))

    def work() -> Array:
        touch_partial, query = next(touches)
        return sample.logits(touch_partial, partials, np.sort(index.search(query[None], k)[1][0]))

    return work


def default_k(sample: Sample) -> int:
    """Return the number of candidates that `build-index` would select for the blended catalogue and these touches.

    It is the first step of `build-index` whose candidates contain enough exhaustive top-1 photos.
    """
    photos = sample.catalogue
    used = next(name for name in photos.embeddings if is_used(sample, name))
    found = ranks(sample.queries[used], photos.embeddings[used], sample.exhaustive_top1)
    return next(k for k in candidate_steps(len(photos.partials)) if np.mean(found < k) >= TARGET)


def is_used(sample: Sample, name: str) -> bool:
    """Return whether search uses this embedding for its candidates."""
    return name == (
        "candidate encoder" if sample.checkpoint.matcher.candidate_encoder is not None else "contrastive embedding"
    )


def ranks(queries: Array, embeddings: Array, exhaustive_top1: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many photos (Q,) are nearer to each query than its exhaustive top-1."""
    found = []
    for query, best in zip(queries, exhaustive_top1, strict=True):
        similarity = embeddings @ query
        found.append(int(np.count_nonzero(similarity > similarity[best])))
    return np.array(found)


# Top-1 answers -------------------------------------------------------------------------------------------


def _lost_top1_panel(sample: Sample) -> Panel:
    """Measure the correct top-1 answers that are lost with fewer candidates, on real photos: blends have no object."""
    rows = sample.touch_rows[: sample.scale.queries]
    queries, partials, count = sample.touch_encodings(rows), sample.real_photo_codes["partial"], len(sample.photo_rows)
    points, works = list[Tradeoff](), list[Callable[[], object]]()
    table = np.array([sample.logits(touch_partial, partials) for touch_partial in queries["partial"]])
    whole = _wrong(sample, table, rows)
    for name in (name for name in queries if name != "partial"):
        index = indexes.build(sample.real_photo_codes[name], threads=1)
        for k in (k for k in (1, 2, 5, *FEW, *candidate_steps(count)) if k < count):
            logits = _candidate_logits(table, index.search(queries[name], k)[1])
            points.append(miss_rate_point(name, f"k = {k:,}", _wrong(sample, logits, rows) & ~whole))
            works.append(_query_work(sample, index, queries, name, partials, k))
    points.append(miss_rate_point("no candidates", "all", rows < 0, count <= EXHAUSTIVE_LIMIT))
    works.append(partial(sample.logits, queries["partial"][0], partials))
    points = list(time_points(points, works, sample.scale.repeats))
    objects = len(np.unique(sample.owner))
    return _panel(f"lost correct top-1 answers, {count} photos of {objects} unseen objects", points, len(rows))


def _candidate_logits(table: Array, rows: NDArray[np.int64]) -> Array:
    """Return logits (Q, N) of the candidates (Q, k); -inf for the others."""
    logits = np.full(table.shape, -np.inf, dtype=np.float32)
    np.put_along_axis(logits, rows, np.take_along_axis(table, rows, 1), 1)
    return logits


def _wrong(sample: Sample, table: Array, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.asarray(sample.owner[sample.photo_rows][table.argmax(1)] != sample.owner[rows])
