"""Kinds of candidate index: missed exhaustive top-1 and missed nearest neighbours against search time."""

from collections.abc import Callable, Iterator
from itertools import cycle

import numpy as np

import indexes
from indexes.errors import ParameterError
from indexes.kinds.faiss_index import FaissIndex
from indexes.kinds.measure import recall_against_exact
from indexes.kinds.vector_index import VectorIndex
from retrieval.console.progress import Bar
from retrieval.frontier.candidates import default_k
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, miss_rate_point
from retrieval.frontier.sample import Array, Sample

NEIGHBOURS = 10
TOLERANCE = 1.0
DEFAULT = "flat"
"""Kind that `build-index` uses unless `--kind` names another one."""
STRUCTURES = {
    "IVF{lists},Flat": ("nprobe", (1, 4, 16, 64)),
    "IVF{lists},SQ8": ("nprobe", (1, 4, 16, 64)),
    "IVF{lists},PQ16": ("nprobe", (4, 16, 64)),
    "HNSW32": ("efSearch", (16, 64, 256, 1024)),
}
"""Factory strings of FAISS, with the search setting that trades time for recall and its values, the fastest first."""


def index_kinds(sample: Sample) -> ApproximationResult:
    """Measure every kind with several settings on the blended catalogue, with the embedding that search uses."""
    name = sample.search_embedding
    if name is None:
        return ApproximationResult("Kind of index", "", skipped="this model has no trained embeddings")
    embeddings, queries = sample.catalogue[name], sample.queries[name]
    k = min(default_k(sample), len(embeddings) // 4)
    misses, lacking = list[Tradeoff](), list[Tradeoff]()
    measured = list[VectorIndex]()
    settings = sum(len(values) for _, values in STRUCTURES.values())
    with Bar("kinds of index", 1 + settings, "settings", quiet=sample.quiet) as bar:
        for series, setting, index in _indexes(embeddings, sample.scale.quick):
            is_default = series == DEFAULT
            missed = ~(index.search(queries, k)[1] == sample.exhaustive_top1[:, None]).any(1)
            misses.append(miss_rate_point(series, setting, missed, is_default))
            lack = 100 * (1 - recall_against_exact(index, queries, NEIGHBOURS))
            lacking.append(Tradeoff(series, setting, lack, is_default=is_default))
            measured.append(index)
            bar.advance()

    def panel(points: list[Tradeoff], title: str, k: int, unit: str, reference: str, resolution: float | None) -> Panel:
        timed = time_points(points, [_query_work(index, queries, k) for index in measured], sample.scale.repeats)
        time = f"search of one query for k = {k:,}, one thread"
        return Panel(title, time, unit, reference, TOLERANCE, timed, resolution)

    top1, neighbours = f"missed exhaustive top-1, k = {k:,} candidates", f"missed nearest {NEIGHBOURS}"
    return ApproximationResult(
        "Kind of index",
        f"Search over {len(embeddings):,} blended photos by the {name}. An answer needs the exhaustive top-1 of the "
        "fusion head among the candidates. The usual measure of such indexes is another one: recall of nearest "
        "neighbours. Exact search is the default: it needs no training, and its recall does not depend on the "
        "catalogue. `build-index --kind` takes the name and the setting of a point, such as HNSW32;efSearch=64.",
        (
            panel(misses, top1, k, "% of queries", "every photo reranked", 100 / len(queries)),
            panel(lacking, neighbours, NEIGHBOURS, "% of neighbours", "exact search", None),
        ),
    )


def _indexes(embeddings: Array, quick: bool) -> Iterator[tuple[str, str, VectorIndex]]:
    """Yield (series, setting, index) of every kind that these embeddings can train."""
    lists = 1 << max(0, round(np.log2(np.sqrt(len(embeddings)))))  # near the square root, a power of two
    yield DEFAULT, "", indexes.build(embeddings, DEFAULT, threads=1)
    for pattern, (setting, values) in STRUCTURES.items():
        kind = pattern.format(lists=lists)
        try:
            built = FaissIndex.build(embeddings, kind)
        except ParameterError:  # too few vectors, or the code does not divide their size
            continue
        for value in values[:1] if quick else values:
            yield kind, f"{setting} = {value}", built.with_settings(f"{setting}={value}")


def _query_work(index: VectorIndex, queries: Array, k: int) -> Callable[[], object]:
    """Return a function that searches one query after the other; a single query uses one thread."""
    remaining = cycle(queries)
    return lambda: index.search(next(remaining)[None], k)
