"""Recall of an index compared with exact search, and its time per query."""

import time
from statistics import median
from typing import Any

import numpy as np

from indexes.errors import ParameterError
from indexes.kinds.faiss_index import FLAT, FaissIndex
from indexes.kinds.vector_index import Floats, VectorIndex, score_tolerance

RECALL_AT, RECALL_QUERIES, TIMED_QUERIES = 10, 100, 20
NOISE = 0.5
"""Length of the displacement of drawn queries; it leaves a cosine near 0.9 with the vector."""


def measured_recall(index: VectorIndex, queries: Floats | None) -> dict[str, Any]:
    """Return recall and time of an index next to those of exact search, the entry "recall" of a manifest.

    Args:
        index: The index.
        queries: Unit queries (Q, d); None to draw `RECALL_QUERIES` near the vectors of the index.
    """
    if index.exact:
        return {"value": 1.0, "at": RECALL_AT, "queries": 0, "how": "exact by construction"}
    how = "measured on displaced vectors of the index" if queries is None else "measured on the given queries"
    if queries is None:
        queries = sample_queries(index.vectors)
    exact = FaissIndex(index.vectors, FLAT)
    times = {"ms": query_ms(index, queries[:TIMED_QUERIES]), "exact_ms": query_ms(exact, queries[:TIMED_QUERIES])}
    return {
        "value": recall_against_exact(index, queries, RECALL_AT),
        "at": RECALL_AT,
        "queries": len(queries),
        "how": how,
        **times,
    }


def sample_queries(vectors: Floats) -> Floats:
    """Draw `RECALL_QUERIES` unit queries near unit vectors (N, d): some of them, each moved in a random direction.

    Queries of another modality are further from the vectors, so prefer real queries if there are any.
    """
    rng = np.random.default_rng(0)
    chosen = vectors[rng.integers(len(vectors), size=RECALL_QUERIES)].astype(np.float64)
    moves = rng.normal(size=chosen.shape)
    moved = chosen + NOISE * moves / np.linalg.norm(moves, axis=1, keepdims=True)
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True), np.float32)


def recall_against_exact(index: VectorIndex, queries: Floats, k: int = 10) -> float:
    """Return the recall@k of an index: the mean fraction of the exact best k that it returns.

    A result is correct if the inner product of its vector reaches the exact k-th score, so ties at rank k are correct.
    An exact index has recall 1.

    Args:
        index: The index.
        queries: Unit queries (Q, d), Q >= 1.
        k: Number of results, lowered to the number of vectors.

    Raises:
        ParameterError: There is no query.

    >>> import numpy as np
    >>> vectors = np.eye(8, dtype=np.float32)
    >>> indexes.recall_against_exact(indexes.build(vectors), vectors, k=3)
    1.0
    """
    if not len(queries):
        raise ParameterError("recall needs at least one query; got none")
    last = FaissIndex(index.vectors, FLAT).search(queries, k)[0][:, -1:]
    rows = index.search(queries, k)[1]
    scores = np.einsum("qd,qkd->qk", queries, index.vectors[rows])
    return float(np.mean((rows >= 0) & (scores >= last - score_tolerance(index.dim))))


def query_ms(index: VectorIndex, queries: Floats) -> float:
    """Return the median milliseconds of a search for each of the unit queries (Q, d), after one untimed search."""
    index.search(queries[:1], RECALL_AT)
    taken = []
    for query in queries[:, None]:
        start = time.perf_counter()
        index.search(query, RECALL_AT)
        taken.append(time.perf_counter() - start)
    return 1e3 * median(taken)
