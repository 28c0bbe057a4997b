"""Number of reranked candidates: miss rate of the exhaustive top-1 against the time of a query."""

from collections.abc import Callable
from functools import partial
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

import indexes
from indexes.kinds.vector_index import VectorIndex
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, miss_rate_point
from retrieval.frontier.sample import Array, Sample
from retrieval.search.build.candidates import TARGET, candidate_steps

FEW = (10, 25, 50, 100, 250)
"""Numbers of candidates below the first one that `build-index` tries."""

TOLERANCE = round(100 * (1 - TARGET), 6)
"""Default tolerance of `build-index`: percent of exhaustive top-1 photos that the candidates may miss."""


def candidates(sample: Sample) -> ApproximationResult:
    """Measure numbers of candidates k: exact search by each embedding of the model, then reranking."""
    if sample.search_embedding is None:
        return ApproximationResult(
            "Candidates", "", skipped="this model has no trained embeddings and reranks every photo"
        )
    photos, best, default = sample.catalogue["partial"], sample.exhaustive_top1, default_k(sample)
    points, works = list[Tradeoff](), list[Callable[[], object]]()
    for name in sample.embeddings:
        found = ranks(sample.queries[name], sample.catalogue[name], best)
        index = indexes.build(sample.catalogue[name], threads=1)
        for k in (*FEW, *candidate_steps(len(photos))[:-1]):
            is_default = k == default and name == sample.search_embedding
            points.append(miss_rate_point(name, f"k = {k:,}", found >= k, is_default))
            works.append(_query_work(sample, index, name, k))
    points.append(miss_rate_point("no candidates", "all", best < 0, default == len(photos)))
    works.append(partial(sample.logits, sample.queries["partial"][0], photos))
    panel = Panel(
        f"missed exhaustive top-1, {len(photos):,} blended photos",
        "search and rerank of one query, one thread",
        "% of queries",
        "every photo reranked",
        TOLERANCE,
        time_points(points, works, sample.scale.repeats),
        100 / len(best),
    )
    return ApproximationResult(
        "Candidates",
        "The fusion head reranks only the k photos nearest in embedding. The reference reranks every photo. The "
        "exhaustive top-1 is the photo that the reference ranks first.",
        (panel,),
    )


def _query_work(sample: Sample, index: VectorIndex, name: str, k: int) -> Callable[[], object]:
    """Return a function that searches and reranks one touch after the other."""
    touches = cycle(zip(sample.queries["partial"], sample.queries[name], strict=True))

    def work() -> Array:
        touch_partial, query = next(touches)
        return sample.logits(touch_partial, sample.catalogue["partial"], np.sort(index.search(query[None], k)[1][0]))

    return work


def default_k(sample: Sample) -> int:
    """Return the number of candidates that `build-index` would select for the blended catalogue and these touches.

    It is the first step of `build-index` whose candidates contain enough exhaustive top-1 photos.
    """
    assert sample.search_embedding
    embeddings = sample.catalogue[sample.search_embedding]
    found = ranks(sample.queries[sample.search_embedding], embeddings, sample.exhaustive_top1)
    return next(k for k in candidate_steps(len(embeddings)) if np.mean(found < k) >= TARGET)


def ranks(queries: Array, embeddings: Array, exhaustive_top1: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many photos (Q,) are nearer to each query than its exhaustive top-1."""
    found = []
    for query, best in zip(queries, exhaustive_top1, strict=True):
        similarity = embeddings @ query
        found.append(int(np.count_nonzero(similarity > similarity[best])))
    return np.array(found)
