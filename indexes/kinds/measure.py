"""Recall of an index compared with exact search, and its time per query."""

import time
from collections.abc import Callable
from statistics import median

import numpy as np

from indexes.errors import ParameterError
from indexes.kinds.checks import check_k, check_unit
from indexes.kinds.scores import Floats, scan
from indexes.kinds.vector_index import VectorIndex

Clock = Callable[[], float]
"""Returns seconds since an arbitrary start."""


def sample_queries(vectors: Floats, count: int, *, seed: int = 0, noise: float = 0.5) -> Floats:
    """Draw unit queries near the vectors: randomly chosen vectors, each moved by `noise` in a random direction.

    Queries of another modality are further from the vectors, so prefer real queries if there are any.

    Args:
        vectors: Unit vectors (M, d).
        count: Number of queries Q.
        seed: Seed of the random choices.
        noise: Length of the displacement; 0.5 leaves a cosine near 0.9 with the vector.

    Returns:
        Unit queries (Q, d) float32.
    """
    rng = np.random.default_rng(seed)
    chosen = vectors[rng.integers(len(vectors), size=count)].astype(np.float64)
    moves = rng.normal(size=chosen.shape)
    moved = chosen + noise * moves / np.linalg.norm(moves, axis=1, keepdims=True)
    queries: Floats = (moved / np.linalg.norm(moved, axis=1, keepdims=True)).astype(np.float32)
    return queries


def recall_against_exact(index: VectorIndex, queries: Floats, k: int = 10) -> float:
    """Return the recall@k of an index: the mean fraction of the exact best k that it returns.

    A result is correct if its score reaches the exact k-th score, so ties at rank k are correct. An exact index has
    recall 1.

    Args:
        index: The index.
        queries: Unit queries (Q, d), Q >= 1.
        k: Number of results, lowered to the number of slots.

    Raises:
        ParameterError: There is no query.

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
    """Return the median milliseconds of single-query searches, after one untimed search.

    Args:
        index: The index.
        queries: Unit queries (Q, d), searched one by one.
        k: Number of results.
        clock: Source of the time in seconds.
    """
    index.search(queries[:1], k)
    taken = []
    for number in range(len(queries)):
        start = clock()
        index.search(queries[number : number + 1], k)
        taken.append(clock() - start)
    return 1e3 * median(taken)
