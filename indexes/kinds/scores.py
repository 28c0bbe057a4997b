"""Bitwise reproducible inner products of unit vectors.

A sum of floating-point products depends on its order. The same pair then scores differently in a batch of 1 and a
batch of 1000, on one thread and on eight, and identical vectors do not tie. Here every component is first rounded
to a multiple of 2^-26. A product of two components is then a multiple of 2^-52. By Cauchy-Schwarz, every partial
sum of products of two vectors with norms up to 1.001 stays below 1.003 in size, that is below 2^53 such multiples.
Float64 represents each of them exactly, so nothing is rounded and every order gives the same sum.

Rounding the components (at most 2^-27 each) moves a score by less than 2^-26 * 1.001 * sqrt(d). This is 3.4e-7 at
d = 512 (typically 1e-8), compared with 6e-8 for float32 itself.
"""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float32]
Doubles: TypeAlias = NDArray[np.float64]
Slots: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]

GRID = 2.0**26
BLOCK_NUMBERS = 1 << 22
"""Numbers in memory at once in the blocked loops (32 MiB of float64)."""


def to_grid(vectors: Floats) -> Doubles:
    """Round components (..., d) to multiples of 2^-26; return the multiples as whole numbers in float64."""
    counted: Doubles = np.rint(vectors.astype(np.float64) * GRID)
    return counted


def grid_scores(queries: Doubles, vectors: Doubles) -> Floats:
    """Return inner products (..., M) float32 of queries (..., d) and vectors (M, d), both from `to_grid`."""
    scores: Floats = (queries @ vectors.T * GRID**-2).astype(np.float32)
    return scores


def error_bound(dim: int) -> float:
    """Return the largest difference between a float32 inner product in any order and `grid_scores`.

    Valid for norms up to 1.001: the classical bound (d + 2) u |x| |y| with u = 2^-24, plus the bound of the grid,
    plus one rounding to float32.
    """
    unit = 2.0**-24
    return 1.01 * ((dim + 2) * unit + math.sqrt(dim) * 2.0**-26 + unit)


def top_k(scores: Floats, slots: Slots, k: int) -> tuple[Floats, Slots]:
    """Return the best k of scores (n,) and their slots, ordered by (-score, slot)."""
    if len(scores) > k:
        reach = scores >= np.partition(scores, len(scores) - k)[len(scores) - k]  # including ties at rank k
        scores, slots = scores[reach], slots[reach]
    order = np.lexsort((slots, -scores))[:k]
    return scores[order], slots[order]


def scan(vectors: Floats, queries: Floats, k: int, live: Mask | None = None) -> tuple[Floats, Slots]:
    """Score every live slot: exact search, the reference for every kind.

    Args:
        vectors: Unit vectors (M, d), read block by block.
        queries: Unit queries (Q, d).
        k: Number of results, at most the number of live slots.
        live: Mask (M,) of the slots to search; None for all.

    Returns:
        Scores (Q, k) float32 and slots (Q, k) int64, ordered by (-score, slot).
    """
    gridded = to_grid(queries)
    found = [(np.empty(0, np.float32), np.empty(0, np.int64))] * len(queries)
    step = max(1, BLOCK_NUMBERS // max(1, len(queries), vectors.shape[1]))
    for start in range(0, len(vectors), step):
        table = grid_scores(gridded, to_grid(vectors[start : start + step]))
        slots = np.arange(start, start + table.shape[1])
        if live is not None:
            slots = slots[live[slots]]
        for query, (scores, before) in enumerate(found):
            row = table[query, slots - start]
            found[query] = top_k(np.concatenate([scores, row]), np.concatenate([before, slots]), k)
    return np.stack([scores for scores, _ in found]), np.stack([slots for _, slots in found])
