"""Which structure finds the candidates: winners that it misses, nearest neighbours that it misses, and its time."""

from collections.abc import Callable, Iterator
from itertools import cycle

import numpy as np

from indexes import KINDS, load_kind
from indexes.kinds.base import VectorIndex
from retrieval.console.progress import Bar
from retrieval.lab.frontier.candidates import default_k, is_used
from retrieval.lab.frontier.clock import timed
from retrieval.lab.frontier.points import Panel, Point, Row, missed, smallest
from retrieval.lab.frontier.sample import Array, Sample

NEIGHBOURS = 10
TOLERANCE = 1.0
DEFAULT = "flat"
"""What `build-index` takes unless it is given a budget that exact search breaks."""
PROBES = (1, 2, 4, 8, 16, 32, 64, 128)
LADDERS: dict[str, tuple[str, tuple[int, ...]]] = {
    "hnsw": ("ef_search", (16, 32, 64, 128, 256, 512, 1000, 2000)),
    "ivf_flat": ("probes", PROBES),
    "ivf_sq8": ("probes", PROBES),
    "ivf_pq": ("probes", PROBES),
}
"""Approximate kind -> the setting that trades time for what it finds; finer than `indexes.kinds.choice`, which looks
for one point and not for the curve."""
CODE_BYTES = (8, 16, 32)
Measured = tuple[Point, Callable[[], object]]


def index_kinds(sample: Sample) -> Row:
    """Every kind and its ladder on the blended catalogue, by the embedding in use."""
    used = [name for name in sample.catalogue.embeddings if is_used(sample, name)]
    if not used:
        return Row("Kind of index", "", skipped="this model has no trained embeddings")
    embeddings, queries = sample.catalogue.embeddings[used[0]], sample.queries[used[0]]
    k = min(default_k(sample), len(embeddings) // 4)
    truth = load_kind("flat").build(embeddings, threads=1).search(queries, NEIGHBOURS)[0]
    near, far = list[Measured](), list[Measured]()
    made = list(_structures(sample, embeddings))
    with Bar("kinds of index", len(made), "settings", quiet=sample.quiet) as bar:
        for series, setting, index in made:
            is_default = series == DEFAULT
            if _matters(setting, k):
                lost = ~(index.search(queries, k)[1] == sample.winners[:, None]).any(1)
                far.append((missed(series, setting, lost, is_default), _asking(index, queries, k)))
            lacking = 100 * float(np.mean(index.search(queries, NEIGHBOURS)[0] < truth[:, -1:]))
            near.append((Point(series, setting, lacking, is_default=is_default), _asking(index, queries, NEIGHBOURS)))
            bar.advance()
    of_winners, of_neighbours = (_timed(sample, each) for each in (far, near))
    return Row(
        "Kind of index",
        f"Search over {len(embeddings):,} blended photos by the {used[0]}. What counts for an answer is whether the "
        "classifier's winner is among the candidates; whether nearest neighbours are found is what such indexes are "
        "usually judged by, and another thing. Exact search is used unless `build-index` is given a bound: it needs no "
        "training, and what it finds does not hang on the catalogue.",
        (
            _panel(
                f"missed winners among k = {k:,} candidates", k, "every photo judged", 100 / len(queries), of_winners
            ),
            _panel(f"missed nearest {NEIGHBOURS}", NEIGHBOURS, "exact search", smallest(of_neighbours), of_neighbours),
        ),
    )


def _timed(sample: Sample, measured: list[Measured]) -> tuple[Point, ...]:
    points, works = zip(*measured, strict=True)
    return timed(points, works, sample.scale.repeats)


def _panel(title: str, k: int, reference: str, resolution: float, points: tuple[Point, ...]) -> Panel:
    unit = "% of neighbours" if reference == "exact search" else "% of queries"
    time = f"search of one query for k = {k:,}, one thread"
    return Panel(title, time, unit, reference, TOLERANCE, points, resolution)


def _structures(sample: Sample, embeddings: Array) -> Iterator[tuple[str, str, VectorIndex]]:
    """(series, setting, index) of every kind; the ladder of one structure is searched, not built again."""
    for kind in KINDS:
        if kind == "exact":  # the oracle of the others
            continue
        setting, values = LADDERS.get(kind, ("", ()))
        values = values[::4] if sample.scale.quick else values
        for name, index in _built(kind, embeddings, CODE_BYTES[:1] if sample.scale.quick else CODE_BYTES):
            for value in values:
                yield name, f"{setting} = {value}", index.tuned(**{setting: value})
            if not values:
                yield name, "", index


def _built(kind: str, embeddings: Array, code_bytes: tuple[int, ...]) -> Iterator[tuple[str, VectorIndex]]:
    made = load_kind(kind)
    if kind != "ivf_pq":
        yield kind, made.build(embeddings)
        return
    for size in (size for size in code_bytes if embeddings.shape[1] % size == 0):
        yield f"{kind}, {size} bytes", made.build(embeddings, made.parameters_from({"code_bytes": size}))


def _matters(setting: str, k: int) -> bool:
    """A graph is searched with a breadth of k at least."""
    name, _, value = setting.partition(" = ")
    return name != "ef_search" or int(value) >= k


def _asking(index: VectorIndex, queries: Array, k: int) -> Callable[[], object]:
    """Search of one query after the other; a single one is searched on one thread."""
    asked = cycle(queries)
    return lambda: index.search(next(asked)[None], k)
