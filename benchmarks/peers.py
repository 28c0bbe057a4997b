"""Kinds of index compared with the libraries that they use or compete with: plain FAISS, hnswlib, usearch.

    OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 python -m benchmarks.peers --photos 100000

One thread. Each engine's search width is the smallest of its values that finds `RECALL` of the best k with half of the
queries. The other half is timed one by one, all engines in turn. Engines that are not installed are left out:
`pip install hnswlib usearch`. Our kinds rescore their results and order them by the exact inner product; the plain
engines do not. A query first needs only the unordered set of candidates (`VectorIndex.candidates`); it is compared with
the plain call for as many results.
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
from indexes.kinds.faiss_index import faiss_call, load_faiss
from indexes.kinds.measure import sample_queries
from indexes.kinds.scores import Floats, Slots, scan

faiss = load_faiss()
DIM, QUERIES, BEST, RECALL = 64, 100, 10, 0.99
LINKS, BREADTH = 32, 80
"""Of every graph: neighbours of a node, and the number of nodes visited during insertion."""
NAMED = (100, 1160)
"""Numbers of candidates; the shipped model scores at most 1,160 of 100,000 photos."""
WIDTHS = (16, 32, 64, 128, 256, 512, 1000, 2000)
DRAWN = {"apart": 0, "in clusters": 100}
"""Distributions of vectors: independent, or this many around a centre."""

Search = Callable[[Floats, int], Slots]
"""A function from one query (1, d) and a width to the slots of its best vectors."""


@dataclass(frozen=True)
class GraphIndex:
    """An engine over vectors.

    Attributes:
        search: search function.
        widths: its widths (one if it is exact).
    """

    search: Search
    widths: tuple[int, ...]


def drawn(count: int, of_a_centre: int, seed: int = 0) -> Floats:
    """Return unit vectors (count, `DIM`)."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(count, DIM))
    if of_a_centre:
        vectors = 0.6 * vectors + rng.normal(size=(count // of_a_centre + 1, DIM))[np.arange(count) // of_a_centre]
    unit: Floats = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    return unit


def ours(kind: str) -> Callable[[Floats], GraphIndex]:
    """Return a builder of one of `indexes.KINDS`."""

    def build(vectors: Floats) -> GraphIndex:
        index = indexes.load_kind(kind).build(vectors, threads=1)
        setting, widths = index.search_ladder or ("", (0,))
        with_settings = {width: index.with_settings(**{setting: width}) if setting else index for width in widths}
        return GraphIndex(lambda query, width: with_settings[width].search(query, BEST)[1][0], widths)

    return build


def bare_flat(vectors: Floats) -> GraphIndex:
    """Build FAISS's exact search."""
    index = faiss.IndexFlatIP(DIM)
    index.add(vectors)
    return GraphIndex(lambda query, _: index.search(query, BEST)[1][0], (0,))


def bare_graph(vectors: Floats) -> GraphIndex:
    """Build FAISS's graph."""
    index = faiss.IndexHNSWFlat(DIM, LINKS, faiss.METRIC_INNER_PRODUCT)
    index.hnsw.efConstruction = BREADTH
    index.add(vectors)
    settings = {width: faiss.SearchParametersHNSW(efSearch=width) for width in WIDTHS}
    return GraphIndex(lambda query, width: index.search(query, BEST, params=settings[width])[1][0], WIDTHS)


def bare_lists(vectors: Floats) -> GraphIndex:
    """Build FAISS's inverted lists with eight bits per number, with as many lists as ours."""
    lists = max(round(len(vectors) ** 0.5), 1)
    index = faiss.index_factory(DIM, f"IVF{lists},SQ8", faiss.METRIC_INNER_PRODUCT)
    index.train(vectors)
    index.add(vectors)
    widths = tuple(takewhile(lambda probes: probes <= lists, (4, 8, 16, 32, 64, 128, 256, 512)))
    settings = {width: faiss.SearchParametersIVF(nprobe=width) for width in widths}
    return GraphIndex(lambda query, width: index.search(query, BEST, params=settings[width])[1][0], widths)


def hnswlib(vectors: Floats) -> GraphIndex:
    """Build the graph of the HNSW authors' library."""
    index = import_module("hnswlib").Index("ip", DIM)
    index.init_index(len(vectors), ef_construction=BREADTH, M=LINKS, random_seed=0)
    index.add_items(vectors, num_threads=1)

    def search(query: Floats, width: int) -> Slots:
        index.set_ef(width)
        slots: Slots = index.knn_query(query, BEST, num_threads=1)[0][0].astype(np.int64)
        return slots

    return GraphIndex(search, WIDTHS)


def usearch(vectors: Floats) -> GraphIndex:
    """Build the graph of usearch."""
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
    """Yield a line for each engine and each distribution of vectors."""
    with faiss_call("being measured", 1):
        for what, of_a_centre in DRAWN.items():
            vectors = drawn(photos, of_a_centre)
            yield from compare_engines(vectors, sample_queries(vectors, queries), f"{photos:,} vectors {what}")


def compare_engines(vectors: Floats, queries: Floats, label: str) -> Iterator[ResultLine]:
    """Yield a line for each engine over the same vectors; half of the queries choose widths, half are timed."""
    choosing, timed = queries[::2], queries[1::2]
    engines, widths, build_s = {}, {}, {}
    for name, build in ENGINES.items():
        start = time.process_time()
        engines[name] = build(vectors)
        build_s[name] = time.process_time() - start
        widths[name] = least_width(engines[name], vectors, choosing)
    times = in_turns({name: partial(found_at, one, widths[name], timed) for name, one in engines.items()}, 5)
    for name, one in engines.items():
        figures = {
            "width": widths[name],
            "recall": recall(one, widths[name], vectors, timed),
            "query_us": 1e6 * times.median(name) / len(timed),
            "build_cpu_s": build_s[name],
        }
        text = (
            f"{label}: {figures['query_us']:.0f} us per query, width {widths[name]}, recall of the best {BEST} "
            f"{figures['recall']:.3f}; built in {build_s[name]:.2f} s of CPU time"
        )
        each = [1e6 * seconds / len(timed) for seconds in times.seconds[name]]
        yield ResultLine("peers", name, text, figures, {"query_us": each})


def named(photos: int = 100_000, queries: int = QUERIES, repetitions: int = 7) -> Iterator[ResultLine]:
    """Yield a line for each kind and each of `NAMED`: our candidates and FAISS's own call for as many, in turn."""
    with faiss_call("being measured", 1):
        vectors = drawn(photos, 0)
        sampled, bare = sample_queries(vectors, queries), faiss.IndexFlatIP(DIM)
        bare.add(vectors)
        for kind in ("flat", "ivf_sq8", "hnsw"):
            index = indexes.load_kind(kind).build(vectors, threads=1)
            structure, settings = getattr(index, "_structure", None) or bare, index.settings()
            for k in NAMED:
                parameters = {
                    "flat": None,
                    "ivf_sq8": faiss.SearchParametersIVF(nprobe=settings.get("probes", 1)),
                    "hnsw": faiss.SearchParametersHNSW(efSearch=max(k, settings.get("ef_search", 1))),
                }[kind]
                times = in_turns(
                    {
                        "ours": lambda index=index, k=k: [index.candidates(query[None], k) for query in sampled],
                        "bare": lambda structure=structure, k=k, parameters=parameters: [
                            structure.search(query[None], k, params=parameters) for query in sampled
                        ],
                    },
                    repetitions,
                )
                each = {arm: [1e6 * one / queries for one in seconds] for arm, seconds in times.seconds.items()}
                ratio = times.ratio("ours", "bare")
                took = np.median(each["ours"])
                text = f"the best {k} of {photos:,} found in {took:.0f} us: {as_text(ratio)} the time of the plain call"
                yield ResultLine("named", kind, text, {"k": k, "ratio": ratio[0]}, each)


def least_width(built: GraphIndex, vectors: Floats, queries: Floats) -> int:
    """Return the first of its widths that reaches `RECALL`, or the last."""
    return next((width for width in built.widths if recall(built, width, vectors, queries) >= RECALL), built.widths[-1])


def recall(built: GraphIndex, width: int, vectors: Floats, queries: Floats) -> float:
    """Return the mean fraction of the best `BEST` that are found."""
    best = scan(vectors, queries, BEST)[1]
    fractions = [np.isin(true, some).mean() for some, true in zip(found_at(built, width, queries), best, strict=True)]
    return float(np.mean(fractions))


def found_at(built: GraphIndex, width: int, queries: Floats) -> list[Slots]:
    """Return the slots of each query, searched one by one."""
    return [built.search(queries[row : row + 1], width) for row in range(len(queries))]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("--photos", type=int, default=100_000)
    photos = parser.parse_args().photos
    for line in chain(named(photos), measure(photos)):
        print(line, flush=True)
