"""Exact search in numpy, by the scores of all pairs in float64: the oracle of every kind of index."""

import numpy as np


def search(vectors, queries, k):
    """Return scores (Q, k) float64 and rows (Q, k) of the best k vectors, ordered by (-score, row)."""
    scores = queries.astype(np.float64) @ vectors.astype(np.float64).T
    rows = np.argsort(-scores, axis=1, kind="stable")[:, :k]
    return np.take_along_axis(scores, rows, axis=1), rows


def disagreements(vectors, queries, scores, rows, tolerance: float) -> list[str]:
    """Return differences between results (Q, k) and exact search; empty if there are none.

    Each score must be the exact score of its row, the scores must be the best k exact scores (any of several tied rows
    is valid), and no row may occur twice. Scores are compared within `tolerance`.
    """
    table = queries.astype(np.float64) @ vectors.astype(np.float64).T
    best = search(vectors, queries, rows.shape[1])[0]
    if scores.shape != rows.shape or best.shape != rows.shape:
        return [f"results must be of shape {best.shape}; got scores {scores.shape} and rows {rows.shape}"]
    found = []
    for query, (row, got) in enumerate(zip(rows, scores, strict=True)):
        if row.min() < 0 or row.max() >= len(vectors):
            found.append(f"query {query}: rows must be in 0..{len(vectors) - 1}; got {row.tolist()}")
            continue
        if len(np.unique(row)) != len(row):
            found.append(f"query {query}: a row comes twice in {row.tolist()}")
        for rank in np.flatnonzero(~(np.abs(got - table[query, row]) <= tolerance)):
            found.append(f"query {query}, rank {rank + 1}: row {row[rank]} does not score {got[rank]:.6g}")
        for rank in np.flatnonzero(~(np.abs(got - best[query]) <= tolerance)):
            found.append(f"query {query}, rank {rank + 1}: {got[rank]:.6g} is not the best left")
    return found
