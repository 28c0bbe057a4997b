"""Inner products of unit vectors that come out the same bit for bit, whatever computes them.

A sum of floating-point products depends on its order, so the same pair scores differently in a batch of one
and a batch of a thousand, on one thread and on eight, and identical vectors stop being ties. Here every
component is first rounded to a multiple of 2^-26. A product of two components is then a multiple of 2^-52,
and by Cauchy-Schwarz every partial sum of products of two vectors with norms up to 1.001 stays below
1.003 in size, that is below 2^53 such multiples: float64 holds each of them exactly. Nothing is ever
rounded, so every order gives the same sum.

The price is the rounding of the components, at most 2^-27 each: the score moves by less than
2^-26 * 1.001 * sqrt(d), which is 3.4e-7 at d = 512 (typically 1e-8), against the 6e-8 of float32 itself.
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
"""Numbers held at once by the blocked loops (32 MiB of float64)."""


def to_grid(vectors: Floats) -> Doubles:
    """The components (..., d) as whole multiples of 2^-26, counted (float64 integers)."""
    counted: Doubles = np.rint(vectors.astype(np.float64) * GRID)
    return counted


def grid_scores(queries: Doubles, vectors: Doubles) -> Floats:
    """Inner products (..., M) float32 of gridded queries (..., d) and gridded vectors (M, d)."""
    scores: Floats = (queries @ vectors.T * GRID**-2).astype(np.float32)
    return scores


def error_bound(dim: int) -> float:
    """How far a float32 inner product of any order may lie from `grid_scores`, for norms up to 1.001.

    The classical bound (d + 2) u |x| |y| with u = 2^-24, plus the grid's bound, plus a rounding to float32.
    """
    unit = 2.0**-24
    return 1.01 * ((dim + 2) * unit + math.sqrt(dim) * 2.0**-26 + unit)


def top_k(scores: Floats, slots: Slots, k: int) -> tuple[Floats, Slots]:
    """The k best of (n,) scores and their slots, ordered by (-score, slot)."""
    if len(scores) > k:
        reach = scores >= np.partition(scores, len(scores) - k)[len(scores) - k]  # the last place's ties too
        scores, slots = scores[reach], slots[reach]
    order = np.lexsort((slots, -scores))[:k]
    return scores[order], slots[order]


def scan(vectors: Floats, queries: Floats, k: int, live: Mask | None = None) -> tuple[Floats, Slots]:
    """Score every slot: (Q, k) scores and slots ordered by (-score, slot), where `live` (M,) is true.

    The vectors (M, d) are read block by block. k must not exceed the number of live slots. This is the reference that
    every kind is measured against.
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
