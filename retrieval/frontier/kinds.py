"""Kinds of candidate index: missed exhaustive top-1 and missed nearest neighbours against search time."""

from collections.abc import Callable, Iterator
from itertools import cycle

import numpy as np

from indexes import KINDS, load_kind
from indexes.errors import ParameterError
from indexes.kinds.vector_index import VectorIndex
from retrieval.console.progress import Bar
from retrieval.frontier.candidates import default_k, is_used
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff, miss_rate_point, smallest_error
from retrieval.frontier.sample import Array, Sample

NEIGHBOURS = 10
TOLERANCE = 1.0
DEFAULT = "flat"
"""Kind that `build-index` uses unless exact search exceeds a given time budget."""
TimedPoint = tuple[Tradeoff, Callable[[], object]]


def index_kinds(sample: Sample) -> ApproximationResult:
    """Measure every kind with several settings on the blended catalogue, with the embedding in use."""
    used = [name for name in sample.catalogue.embeddings if is_used(sample, name)]
    if not used:
        return ApproximationResult("Kind of index", "", skipped="this model has no trained embeddings")
    embeddings, queries = sample.catalogue.embeddings[used[0]], sample.queries[used[0]]
    k = min(default_k(sample), len(embeddings) // 4)
    truth = load_kind("flat").build(embeddings, threads=1).search(queries, NEIGHBOURS)[0]
    near, far = list[TimedPoint](), list[TimedPoint]()
    made = list(_structures(sample, embeddings))
    with Bar("kinds of index", len(made), "settings", quiet=sample.quiet) as bar:
        for series, setting, index in made:
            is_default = series == DEFAULT
            if _is_comparable(setting, k):
                lost = ~(index.search(queries, k)[1] == sample.exhaustive_top1[:, None]).any(1)
                far.append((miss_rate_point(series, setting, lost, is_default), _query_work(index, queries, k)))
            lacking = 100 * float(np.mean(index.search(queries, NEIGHBOURS)[0] < truth[:, -1:]))
            near.append(
                (Tradeoff(series, setting, lacking, is_default=is_default), _query_work(index, queries, NEIGHBOURS))
            )
            bar.advance()
    of_top1, of_neighbours = (_time_all(sample, each) for each in (far, near))
    return ApproximationResult(
        "Kind of index",
        f"Search over {len(embeddings):,} blended photos by the {used[0]}. An answer needs the exhaustive top-1 of the "
        "fusion head among the candidates. The usual measure of such indexes is another one: recall of nearest "
        "neighbours. Exact search is the default unless `build-index` gets a bound for recall or time: it needs no "
        "training, and its recall does not depend on the catalogue.",
        (
            _panel(
                f"missed exhaustive top-1, k = {k:,} candidates", k, "every photo reranked", 100 / len(queries), of_top1
            ),
            _panel(
                f"missed nearest {NEIGHBOURS}", NEIGHBOURS, "exact search", smallest_error(of_neighbours), of_neighbours
            ),
        ),
    )


def _time_all(sample: Sample, measured: list[TimedPoint]) -> tuple[Tradeoff, ...]:
    points, works = zip(*measured, strict=True)
    return time_points(points, works, sample.scale.repeats)


def _panel(title: str, k: int, reference: str, resolution: float, points: tuple[Tradeoff, ...]) -> Panel:
    unit = "% of neighbours" if reference == "exact search" else "% of queries"
    time = f"search of one query for k = {k:,}, one thread"
    return Panel(title, time, unit, reference, TOLERANCE, points, resolution)


def _structures(sample: Sample, embeddings: Array) -> Iterator[tuple[str, str, VectorIndex]]:
    """Yield (series, setting, index) of every kind; search settings of one index do not rebuild it."""
    for kind in KINDS:
        if kind == "exact":  # the reference of the others
            continue
        for name, built in _build_variants(kind, embeddings, sample.scale.quick):
            ladder = list(built.search_variants())
            for index in ladder[::4] if sample.scale.quick else ladder:
                with_settings = built.search_ladder and built.search_ladder[0]
                yield name, f"{with_settings} = {index.settings()[with_settings]}" if with_settings else "", index


def _build_variants(kind: str, embeddings: Array, quick: bool) -> Iterator[tuple[str, VectorIndex]]:
    """Yield (series, index) of a kind, with each value of its `build_ladder` that fits these embeddings."""
    made = load_kind(kind)
    if made.build_ladder is None:
        yield kind, made.build(embeddings)
        return
    setting, values = made.build_ladder
    for value in values[:1] if quick else values:
        try:
            index = made.build(embeddings, made.parameters_from({setting: value}))
        except ParameterError:  # the code size does not divide the vector
            continue
        yield f"{kind}, {setting} = {value}", index


def _is_comparable(setting: str, k: int) -> bool:
    """Return whether the setting can return k candidates: a graph needs a search breadth of at least k."""
    name, _, value = setting.partition(" = ")
    return name != "ef_search" or int(value) >= k


def _query_work(index: VectorIndex, queries: Array, k: int) -> Callable[[], object]:
    """Return a function that searches one query after the other; a single query uses one thread."""
    remaining = cycle(queries)
    return lambda: index.search(next(remaining)[None], k)
