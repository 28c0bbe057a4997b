"""Search for candidates: missed exhaustive top-1 photos against the time of a query.

Two settings trade accuracy for time: the number of candidates that the fusion head reranks, and the kind of index that
finds them.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

import indexes
from indexes.errors import ParameterError
from indexes.kinds.faiss_index import FaissIndex
from indexes.kinds.vector_index import VectorIndex
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, miss_rate_point
from retrieval.frontier.sample import Array, Sample
from retrieval.indexing.candidates import TARGET, candidate_steps

FEW = (10, 25, 50, 100, 250)
"""Numbers of candidates below the first one that `build-index` tries."""
STRUCTURES = {
    "IVF{lists},Flat": ("nprobe", (1, 4, 16, 64)),
    "IVF{lists},SQ8": ("nprobe", (1, 4, 16, 64)),
    "IVF{lists},PQ16": ("nprobe", (4, 16, 64)),
    "HNSW32": ("efSearch", (16, 64, 256, 1024)),
}
"""Factory strings of FAISS, with the search setting that trades time for recall and its values, the fastest first."""
DEFAULT_KIND = "flat"
"""Kind that `build-index` uses unless `--kind` names another one."""
TOLERANCE = round(100 * (1 - TARGET), 6)
"""Default tolerance of `build-index`: percent of exhaustive top-1 photos that the candidates may miss."""
NO_EMBEDDINGS = "Left out: this model has no trained embeddings and reranks every photo."


def candidates(sample: Sample) -> ApproximationResult:
    """Measure numbers of candidates k: exact search by each embedding of the model, then reranking."""
    if not sample.embeddings:
        return ApproximationResult("Candidates", NO_EMBEDDINGS)
    photos, best, default = sample.catalogue["partial"], sample.exhaustive_top1, default_k(sample)
    points, works = list[Tradeoff](), list[Callable[[], object]]()
    for name in sample.embeddings:
        found = ranks(sample.queries[name], sample.catalogue[name], best)
        index = indexes.build(sample.catalogue[name])
        for k in (*FEW, *candidate_steps(len(photos))[:-1]):
            is_default = k == default and name == sample.embeddings[0]
            points.append(miss_rate_point(name, f"k = {k:,}", found >= k, is_default))
            works.append(_rerank_work(sample, index, name, k))
    points.append(miss_rate_point("no candidates", "all", best < 0, default == len(photos)))
    works.append(partial(sample.logits, sample.queries["partial"][0], photos))
    time = "search and rerank of one query, one thread"
    return ApproximationResult(
        "Candidates",
        "The fusion head reranks only the k photos nearest in embedding. The reference reranks every photo. The "
        "exhaustive top-1 is the photo that the reference ranks first.",
        (_panel(sample, f"missed exhaustive top-1, {len(photos):,} blended photos", time, points, works),),
    )


def index_kinds(sample: Sample) -> ApproximationResult:
    """Measure every kind with several settings on the blended catalogue, with the embedding that search uses."""
    if not sample.embeddings:
        return ApproximationResult("Kind of index", NO_EMBEDDINGS)
    name = sample.embeddings[0]
    embeddings, queries = sample.catalogue[name], sample.queries[name]
    k = min(default_k(sample), len(embeddings) // 4)
    points, works = list[Tradeoff](), list[Callable[[], object]]()
    for series, setting, index in _indexes(embeddings, sample.scale.quick):
        missed = ~(index.search(queries, k)[1] == sample.exhaustive_top1[:, None]).any(1)
        points.append(miss_rate_point(series, setting, missed, series == DEFAULT_KIND))
        works.append(_search_work(index, queries, k))
    time = f"search of one query for k = {k:,}, one thread"
    return ApproximationResult(
        "Kind of index",
        f"Search over {len(embeddings):,} blended photos by the {name}. An answer needs the exhaustive top-1 of the "
        "fusion head among the candidates. Exact search is the default: it needs no training, and its recall does not "
        "depend on the catalogue. `build-index --kind` takes the name and the setting of a point, such as "
        "HNSW32;efSearch=64.",
        (_panel(sample, f"missed exhaustive top-1, k = {k:,} candidates", time, points, works),),
    )


def _panel(sample: Sample, title: str, time: str, points: list[Tradeoff], works: list[Callable[[], object]]) -> Panel:
    timed = time_points(points, works, sample.scale.repeats)
    return Panel(title, time, "% of queries", "every photo reranked", TOLERANCE, timed)


def _rerank_work(sample: Sample, index: VectorIndex, name: str, k: int) -> Callable[[], object]:
    touches = cycle(zip(sample.queries["partial"], sample.queries[name], strict=True))

    def work() -> Array:
        touch_partial, query = next(touches)
        return sample.logits(touch_partial, sample.catalogue["partial"], np.sort(index.search(query[None], k)[1][0]))

    return work


def _search_work(index: VectorIndex, queries: Array, k: int) -> Callable[[], object]:
    remaining = cycle(queries)
    return lambda: index.search(next(remaining)[None], k)


def default_k(sample: Sample) -> int:
    """Return the number of candidates that `build-index` would select for the blended catalogue and these touches.

    It is the first step of `build-index` whose candidates contain enough exhaustive top-1 photos.
    """
    name = sample.embeddings[0]
    found = ranks(sample.queries[name], sample.catalogue[name], sample.exhaustive_top1)
    return next(k for k in candidate_steps(len(sample.catalogue[name])) if np.mean(found < k) >= TARGET)


def ranks(queries: Array, embeddings: Array, exhaustive_top1: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many photos (Q,) are nearer to each query than its exhaustive top-1."""
    similarities = zip((embeddings @ query for query in queries), exhaustive_top1, strict=True)
    return np.array([np.count_nonzero(similarity > similarity[best]) for similarity, best in similarities])


def _indexes(embeddings: Array, quick: bool) -> Iterator[tuple[str, str, VectorIndex]]:
    """Yield (series, setting, index) of every kind that these embeddings can train."""
    lists = 1 << max(0, round(np.log2(np.sqrt(len(embeddings)))))  # near the square root, a power of two
    yield DEFAULT_KIND, "", indexes.build(embeddings, DEFAULT_KIND)
    for pattern, (setting, values) in STRUCTURES.items():
        kind = pattern.format(lists=lists)
        try:
            built = FaissIndex.build(embeddings, kind)
        except ParameterError:  # too few vectors, or the code does not divide their size
            continue
        for value in values[:1] if quick else values:
            yield kind, f"{setting} = {value}", built.with_settings(f"{setting}={value}")
