"""Check of search results against the scores of all pairs."""

import numpy as np

from indexes.kinds.scores import grid_scores, to_grid


def disagreements(vectors, queries, scores, slots, tolerance: float) -> list[str]:
    """Return differences between results (Q, k) and exact search; empty if there are none.

    Each score must be the exact score of its slot, the scores must be the best k exact scores (any of several tied
    slots is valid), and no slot may occur twice. Scores are compared within `tolerance`.
    """
    table = grid_scores(to_grid(queries), to_grid(vectors))
    best = -np.sort(-table, axis=1)[:, : slots.shape[1]]
    if scores.shape != slots.shape or best.shape != slots.shape:
        return [f"results must be of shape {best.shape}; got scores {scores.shape} and slots {slots.shape}"]
    found = []
    for query, (row, got) in enumerate(zip(slots, scores, strict=True)):
        if row.min() < 0 or row.max() >= len(vectors):
            found.append(f"query {query}: slots must be in 0..{len(vectors) - 1}; got {row.tolist()}")
            continue
        if len(np.unique(row)) != len(row):
            found.append(f"query {query}: a slot comes twice in {row.tolist()}")
        for rank in np.flatnonzero(~(np.abs(got - table[query, row]) <= tolerance)):
            found.append(f"query {query}, rank {rank + 1}: slot {row[rank]} does not score {got[rank]:.6g}")
        for rank in np.flatnonzero(~(np.abs(got - best[query]) <= tolerance)):
            found.append(f"query {query}, rank {rank + 1}: {got[rank]:.6g} is not the best left")
    return found
