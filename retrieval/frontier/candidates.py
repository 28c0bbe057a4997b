"""How many photos the full classifier judges: the share of winners that the candidates leave out, and what it costs."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexes import load_kind
from indexes.kinds.vector_index import VectorIndex
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, miss_rate_point
from retrieval.frontier.sample import Array, Sample
from retrieval.search.build.measuring import EXHAUSTIVE_LIMIT, SHORT_LADDER, candidate_steps
from retrieval.search.build.operating import TARGET

TOLERANCE = 100 * (1 - TARGET)
"""Percent of winners that `build-index` lets candidates miss unless it is told otherwise."""


def candidates(sample: Sample) -> ApproximationResult:
    """Candidates k by every embedding the model has, exact search, then the rerank of what was found."""
    if not sample.queries.keys() - {"partial"}:
        return ApproximationResult(
            "Candidates", "", skipped="this model has no trained embeddings and judges every photo"
        )
    return ApproximationResult(
        "Candidates",
        "The full classifier judges only the k photos nearest in embedding. The reference judges all of them. A winner "
        "is the photo that the reference ranks first.",
        (_missed_top1_panel(sample), _lost_top1_panel(sample)),
    )


def _missed_top1_panel(sample: Sample) -> Panel:
    photos, points, works = sample.catalogue, list[Tradeoff](), list[Callable[[], object]]()
    count, default = len(photos.partials), default_k(sample)
    for name, embeddings in photos.embeddings.items():
        found = ranks(sample.queries[name], embeddings, sample.exhaustive_top1)
        index = load_kind("flat").build(embeddings, threads=1)
        for k in (*SHORT_LADDER[::-1], *candidate_steps(count)[:-1]):
            points.append(miss_rate_point(name, f"k = {k:,}", found >= k, k == default and is_used(sample, name)))
            works.append(_query_work(sample, index, sample.queries, name, photos.partials, k))
    points.append(miss_rate_point("no candidates", "all", sample.exhaustive_top1 < 0, default == count))
    works.append(partial(sample.logits, sample.queries["partial"][0], photos.partials))
    points = list(time_points(points, works, sample.scale.repeats))
    return _panel(f"missed winners, {count:,} blended photos", points, len(sample.exhaustive_top1))


def _panel(title: str, points: Sequence[Tradeoff], queries: int) -> Panel:
    return Panel(
        title=title,
        time="search and rerank of one query, one thread",
        unit="% of queries",
        reference="every photo judged",
        tolerance=round(TOLERANCE, 6),
        points=tuple(points),
        resolution=100 / queries,
    )


def _query_work(
    sample: Sample, index: VectorIndex, asked: Mapping[str, Array], name: str, partials: NDArray[Any], k: int
) -> Callable[[], object]:
    """Search and rerank of one touch after the other."""
    touches = cycle(zip(asked["partial"], asked[name], strict=True))

    def ask() -> Array:
        partial_activation, query = next(touches)
        return sample.logits(partial_activation, partials, np.sort(index.search(query[None], k)[1][0]))

    return ask


def default_k(sample: Sample) -> int:
    """What `build-index` would write into the index of the blended catalogue, these touches asked: the first of its
    steps whose candidates hold enough winners.
    """
    photos = sample.catalogue
    used = next(name for name in photos.embeddings if is_used(sample, name))
    found = ranks(sample.queries[used], photos.embeddings[used], sample.exhaustive_top1)
    return next(k for k in candidate_steps(len(photos.partials)) if np.mean(found < k) >= TARGET)


def is_used(sample: Sample, name: str) -> bool:
    """Whether search takes its candidates by this embedding."""
    return name == (
        "candidate encoder" if sample.checkpoint.matcher.candidate_encoder is not None else "contrastive embedding"
    )


def ranks(queries: Array, embeddings: Array, exhaustive_top1: NDArray[np.int64]) -> NDArray[np.int64]:
    """(Q,) how many photos lie nearer to each query than its winner does."""
    found = []
    for query, winner in zip(queries, exhaustive_top1, strict=True):
        nearness = embeddings @ query
        found.append(int(np.count_nonzero(nearness > nearness[winner])))
    return np.array(found)


# First guesses -------------------------------------------------------------------------------------------


def _lost_top1_panel(sample: Sample) -> Panel:
    """First guesses lost to fewer candidates; on real photos only, as a blend is of no object."""
    rows = sample.touch_rows[: sample.scale.queries]
    asked, partials, count = sample.touch_encodings(rows), sample.real_photo_codes["partial"], len(sample.photo_rows)
    points, works = list[Tradeoff](), list[Callable[[], object]]()
    table = np.array([sample.logits(partial_activation, partials) for partial_activation in asked["partial"]])
    whole = _wrong(sample, table, rows)
    for name in (name for name in asked if name != "partial"):
        index = load_kind("flat").build(sample.real_photo_codes[name], threads=1)
        for k in (k for k in (1, 2, 5, *SHORT_LADDER[::-1], *candidate_steps(count)) if k < count):
            judged = _candidate_logits(table, index.search(asked[name], k)[1])
            points.append(miss_rate_point(name, f"k = {k:,}", _wrong(sample, judged, rows) & ~whole))
            works.append(_query_work(sample, index, asked, name, partials, k))
    points.append(miss_rate_point("no candidates", "all", rows < 0, count <= EXHAUSTIVE_LIMIT))
    works.append(partial(sample.logits, asked["partial"][0], partials))
    points = list(time_points(points, works, sample.scale.repeats))
    objects = len(np.unique(sample.owner))
    return _panel(f"right first guesses lost, {count} photos of {objects} unseen objects", points, len(rows))


def _candidate_logits(table: Array, slots: NDArray[np.int64]) -> Array:
    """Logits (Q, N) of the candidates (Q, k), all others last."""
    judged = np.full(table.shape, -np.inf, dtype=np.float32)
    np.put_along_axis(judged, slots, np.take_along_axis(table, slots, 1), 1)
    return judged


def _wrong(sample: Sample, table: Array, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.asarray(sample.owner[sample.photo_rows][table.argmax(1)] != sample.owner[rows])
