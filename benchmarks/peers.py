"""Kinds of index beside the libraries that they stand on or against: FAISS as it is, hnswlib, usearch.

    OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 python -m benchmarks.peers --photos 100000

One thread. Each engine's search width is the least of its ladder that finds `RECALL` of the best k with half of the
queries; the other half is timed one by one, all engines in turns. Those that are not installed are left out:
`pip install hnswlib usearch`. Ours score what they find again and order it by the exact inner product, which the bare
engines do not. What a query needs of them first, the names of candidates in no order (`VectorIndex.candidates`), stands
beside the bare call that names as many.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import chain, takewhile

import numpy as np

import indexes
from benchmarks.common import ResultLine, as_text, in_turns
from indexes.kinds.faiss_index import faiss, faiss_call
from indexes.kinds.measure import sample_queries
from indexes.kinds.scores import Floats, Slots, scan

DIM, QUERIES, BEST, RECALL = 64, 100, 10, 0.99
LINKS, BREADTH = 32, 80
"""Of every graph: neighbours of a node, and how many are looked at while it is built."""
NAMED = (100, 1160)
"""Candidates to name; the shipped model judges 1,160 of 100,000 photos, or fewer."""
WIDTHS = (16, 32, 64, 128, 256, 512, 1000, 2000)
DRAWN = {"apart": 0, "in clusters": 100}
"""Vectors to search among: each drawn for itself, or so many around a centre."""

Search = Callable[[Floats, int], Slots]
"""The slots of the best of one query (1, d), found with a width."""


@dataclass(frozen=True)
class GraphIndex:
    """An engine over vectors: how to search it, and what widths there are (one where it is exact)."""

    search: Search
    widths: tuple[int, ...]


def drawn(count: int, of_a_centre: int, seed: int = 0) -> Floats:
    """Unit vectors (count, `DIM`)."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(count, DIM))
    if of_a_centre:
        vectors = 0.6 * vectors + rng.normal(size=(count // of_a_centre + 1, DIM))[np.arange(count) // of_a_centre]
    unit: Floats = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    return unit


def ours(kind: str) -> Callable[[Floats], GraphIndex]:
    """One of `indexes.KINDS`."""

    def build(vectors: Floats) -> GraphIndex:
        index = indexes.load_kind(kind).build(vectors, threads=1)
        setting, widths = index.search_ladder or ("", (0,))
        with_settings = {width: index.with_settings(**{setting: width}) if setting else index for width in widths}
        return GraphIndex(lambda query, width: with_settings[width].search(query, BEST)[1][0], widths)

    return build


def bare_flat(vectors: Floats) -> GraphIndex:
    """FAISS's exact search."""
    index = faiss.IndexFlatIP(DIM)
    index.add(vectors)
    return GraphIndex(lambda query, _: index.search(query, BEST)[1][0], (0,))


def bare_graph(vectors: Floats) -> GraphIndex:
    """FAISS's graph."""
    index = faiss.IndexHNSWFlat(DIM, LINKS, faiss.METRIC_INNER_PRODUCT)
    index.hnsw.efConstruction = BREADTH
    index.add(vectors)
    settings = {width: faiss.SearchParametersHNSW(efSearch=width) for width in WIDTHS}
    return GraphIndex(lambda query, width: index.search(query, BEST, params=settings[width])[1][0], WIDTHS)


def bare_lists(vectors: Floats) -> GraphIndex:
    """FAISS's inverted lists with eight bits a number, as many lists as ours."""
    lists = max(round(len(vectors) ** 0.5), 1)
    index = faiss.index_factory(DIM, f"IVF{lists},SQ8", faiss.METRIC_INNER_PRODUCT)
    index.train(vectors)
    index.add(vectors)
    widths = tuple(takewhile(lambda probes: probes <= lists, (4, 8, 16, 32, 64, 128, 256, 512)))
    settings = {width: faiss.SearchParametersIVF(nprobe=width) for width in widths}
    return GraphIndex(lambda query, width: index.search(query, BEST, params=settings[width])[1][0], widths)


def hnswlib(vectors: Floats) -> GraphIndex:
    """The graph by those who described it."""
    index = import_module("hnswlib").Index("ip", DIM)
    index.init_index(len(vectors), ef_construction=BREADTH, M=LINKS, random_seed=0)
    index.add_items(vectors, num_threads=1)

    def search(query: Floats, width: int) -> Slots:
        index.set_ef(width)
        slots: Slots = index.knn_query(query, BEST, num_threads=1)[0][0].astype(np.int64)
        return slots

    return GraphIndex(search, WIDTHS)


def usearch(vectors: Floats) -> GraphIndex:
    """A graph by others."""
    index = import_module("usearch.index").Index(
        ndim=DIM, metric="ip", dtype="f32", connectivity=LINKS, expansion_add=BREADTH
    )
    index.add(np.arange(len(vectors)), vectors, threads=1)

    def search(query: Floats, width: int) -> Slots:
        index.expansion_search = width
        slots: Slots = index.search(query[0], BEST, threads=1).keys.astype(np.int64)
        return slots

    return GraphIndex(search, WIDTHS)


ENGINES: Mapping[str, Callable[[Floats], GraphIndex]] = {
    "flat (ours)": ours("flat"),
    "FAISS flat": bare_flat,
    "ivf_sq8 (ours)": ours("ivf_sq8"),
    "FAISS IVF, SQ8": bare_lists,
    "hnsw (ours)": ours("hnsw"),
    "FAISS HNSW": bare_graph,
    **{name: build for name, build in {"hnswlib": hnswlib, "usearch": usearch}.items() if find_spec(name)},
}


def measure(photos: int = 100_000, queries: int = QUERIES) -> Iterator[ResultLine]:
    """A line for each engine and each way to draw vectors."""
    with faiss_call("being measured", 1):
        for what, of_a_centre in DRAWN.items():
            vectors = drawn(photos, of_a_centre)
            yield from compare_engines(vectors, sample_queries(vectors, queries), f"{photos:,} vectors {what}")


def compare_engines(vectors: Floats, queries: Floats, what: str) -> Iterator[ResultLine]:
    """A line for each engine over the same vectors; half of the queries choose widths, half are timed."""
    choosing, timed = queries[::2], queries[1::2]
    engines, widths, took = {}, {}, {}
    for name, build in ENGINES.items():
        start = time.process_time()
        engines[name] = build(vectors)
        took[name] = time.process_time() - start
        widths[name] = least_width(engines[name], vectors, choosing)
    times = in_turns({name: partial(found_at, one, widths[name], timed) for name, one in engines.items()}, 5)
    for name, one in engines.items():
        figures = {
            "width": widths[name],
            "recall": recall(one, widths[name], vectors, timed),
            "query_us": 1e6 * times.median(name) / len(timed),
            "build_cpu_s": took[name],
        }
        text = (
            f"{what}: {figures['query_us']:.0f} us a query, width {widths[name]}, recall of the best {BEST} "
            f"{figures['recall']:.3f}; built in {took[name]:.2f} s of CPU time"
        )
        each = [1e6 * seconds / len(timed) for seconds in times.seconds[name]]
        yield ResultLine("peers", name, text, figures, {"query_us": each})


def named(photos: int = 100_000, queries: int = QUERIES, repetitions: int = 7) -> Iterator[ResultLine]:
    """A line for each kind and each of `NAMED`: naming candidates, beside FAISS's own call for as many, in turns."""
    with faiss_call("being measured", 1):
        vectors = drawn(photos, 0)
        asked, bare = sample_queries(vectors, queries), faiss.IndexFlatIP(DIM)
        bare.add(vectors)
        for kind in ("flat", "ivf_sq8", "hnsw"):
            index = indexes.load_kind(kind).build(vectors, threads=1)
            structure, settings = getattr(index, "_structure", None) or bare, index.settings()
            for k in NAMED:
                how = {
                    "flat": None,
                    "ivf_sq8": faiss.SearchParametersIVF(nprobe=settings.get("probes", 1)),
                    "hnsw": faiss.SearchParametersHNSW(efSearch=max(k, settings.get("ef_search", 1))),
                }[kind]
                times = in_turns(
                    {
                        "ours": lambda index=index, k=k: [index.candidates(query[None], k) for query in asked],
                        "bare": lambda structure=structure, k=k, how=how: [
                            structure.search(query[None], k, params=how) for query in asked
                        ],
                    },
                    repetitions,
                )
                each = {arm: [1e6 * one / queries for one in seconds] for arm, seconds in times.seconds.items()}
                ratio = times.ratio("ours", "bare")
                took = np.median(each["ours"])
                text = f"the best {k} of {photos:,} named in {took:.0f} us: {as_text(ratio)} the bare call"
                yield ResultLine("named", kind, text, {"k": k, "ratio": ratio[0]}, each)


def least_width(built: GraphIndex, vectors: Floats, queries: Floats) -> int:
    """The first of its widths that reaches `RECALL`, or the last."""
    return next((width for width in built.widths if recall(built, width, vectors, queries) >= RECALL), built.widths[-1])


def recall(built: GraphIndex, width: int, vectors: Floats, queries: Floats) -> float:
    """Mean share of the best `BEST` that are found."""
    best = scan(vectors, queries, BEST)[1]
    shares = [np.isin(true, some).mean() for some, true in zip(found_at(built, width, queries), best, strict=True)]
    return float(np.mean(shares))


def found_at(built: GraphIndex, width: int, queries: Floats) -> list[Slots]:
    """The slots of each query, asked one by one."""
    return [built.search(queries[row : row + 1], width) for row in range(len(queries))]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("--photos", type=int, default=100_000)
    photos = parser.parse_args().photos
    for line in chain(named(photos), measure(photos)):
        print(line, flush=True)
