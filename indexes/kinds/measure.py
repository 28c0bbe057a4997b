"""How well and how fast an index answers, against the exact search."""

import time
from collections.abc import Callable
from statistics import median

import numpy as np

from indexes.errors import ParameterError
from indexes.kinds.checks import check_k, check_unit
from indexes.kinds.scores import Floats, scan
from indexes.kinds.vector_index import VectorIndex

Clock = Callable[[], float]
"""Seconds from some start."""


def sample_queries(vectors: Floats, count: int, *, seed: int = 0, noise: float = 0.5) -> Floats:
    """`count` unit queries (count, d): vectors drawn at random, each moved by `noise` in a random direction.

    A noise of 0.5 leaves a cosine near 0.9 with the vector. Queries of another modality lie further away, so
    where real queries are at hand, measure with those.
    """
    rng = np.random.default_rng(seed)
    chosen = vectors[rng.integers(len(vectors), size=count)].astype(np.float64)
    moves = rng.normal(size=chosen.shape)
    moved = chosen + noise * moves / np.linalg.norm(moves, axis=1, keepdims=True)
    queries: Floats = (moved / np.linalg.norm(moved, axis=1, keepdims=True)).astype(np.float32)
    return queries


def recall_against_exact(index: VectorIndex, queries: Floats, k: int = 10) -> float:
    """Mean share of the exact best k that `index` returns for unit queries (Q, d), Q >= 1.

    A result counts when its score reaches the exact k-th score: a tie partner is as good. k is lowered to the
    number of slots. An index that is exact has recall 1.

    >>> import numpy as np
    >>> vectors = np.eye(8, dtype=np.float32)
    >>> indexes.recall_against_exact(indexes.load_kind("flat").build(vectors), vectors, k=3)
    1.0
    """
    k = min(check_k(k), index.count)
    table = check_unit(queries, dim=index.dim, what="query")
    if not len(table):
        raise ParameterError("recall needs at least one query; got none")
    truth = scan(index.vectors, table, k)[0]
    return float(np.mean(index.search(table, k)[0] >= truth[:, -1:]))


def query_ms(index: VectorIndex, queries: Floats, k: int = 10, *, clock: Clock = time.perf_counter) -> float:
    """Median milliseconds of one query (Q, d) asked alone, after one that is not counted."""
    index.search(queries[:1], k)
    taken = []
    for number in range(len(queries)):
        start = clock()
        index.search(queries[number : number + 1], k)
        taken.append(clock() - start)
    return 1e3 * median(taken)
