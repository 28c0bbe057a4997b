"""Which of many vectors are equal, byte for byte."""

import numpy as np
from numpy.typing import NDArray

from indexes.kinds.checks import BLOCK_ROWS
from indexes.kinds.scores import Floats, Slots

BEGINNING = 16
"""Components that are compared at first."""


def first_of_equals(vectors: Floats, seed: int = 0) -> Slots:
    """For each vector (M,) the first that holds the same bytes. The vectors (M, d) are read block by block.

    Equal hashes are taken for a hint and the bytes compared; where they differ, another hash sorts them out.
    """
    hashes = _hashes(vectors, seed)
    ranked = np.sort(hashes)
    if (ranked[1:] != ranked[:-1]).all():  # as where no photo is a copy, in a tenth of the time
        return np.arange(len(vectors))
    _, first, group = np.unique(hashes, return_index=True, return_inverse=True)
    result: Slots = first[group]
    copies = np.flatnonzero(result != np.arange(len(vectors)))
    differ = np.zeros(len(copies), bool)
    for start in range(0, len(copies), BLOCK_ROWS):
        part = copies[start : start + BLOCK_ROWS]
        left, right = (vectors[numbers].view(np.uint32) for numbers in (part, result[part]))
        differ[start : start + BLOCK_ROWS] = (left != right).any(axis=1)
    odd = copies[differ]
    if len(odd):
        result[odd] = odd[first_of_equals(vectors[odd], seed + 1)]
    return result


def _hashes(vectors: Floats, seed: int) -> NDArray[np.uint64]:
    """A hash (M,) of the bytes of each vector: its 32-bit words by random odd numbers, summed modulo 2^64. At first of
    its beginning alone, which tells embeddings apart."""
    count = min(vectors.shape[1], BEGINNING) if seed == 0 else vectors.shape[1]
    drawn = np.random.default_rng(seed).integers(2**63, size=count, dtype=np.uint64)
    factors = drawn * np.uint64(2) + np.uint64(1)
    hashes = np.empty(len(vectors), np.uint64)
    for start in range(0, len(vectors), BLOCK_ROWS):
        words = np.ascontiguousarray(vectors[start : start + BLOCK_ROWS, : len(factors)]).view(np.uint32)
        hashes[start : start + BLOCK_ROWS] = (words * factors).sum(axis=1, dtype=np.uint64)
    return hashes
