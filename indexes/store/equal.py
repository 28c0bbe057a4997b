"""Search for vectors that are equal byte for byte."""

import numpy as np

from indexes.kinds.checks import BLOCK_ROWS
from indexes.kinds.scores import Floats, Slots

COMPARED_COMPONENTS = 16
"""Components that are hashed first: they distinguish embeddings."""


def first_equal_rows(vectors: Floats) -> Slots:
    """Return for each vector the row (M,) of the first vector with the same bytes.

    Args:
        vectors: Vectors (M, d), read block by block.
    """
    drawn = np.random.default_rng(0).integers(2**63, size=min(vectors.shape[1], COMPARED_COMPONENTS), dtype=np.uint64)
    factors = drawn * np.uint64(2) + np.uint64(1)
    hashes = np.empty(len(vectors), np.uint64)
    for start in range(0, len(vectors), BLOCK_ROWS):
        words = np.ascontiguousarray(vectors[start : start + BLOCK_ROWS, :COMPARED_COMPONENTS]).view(np.uint32)
        hashes[start : start + BLOCK_ROWS] = (words * factors).sum(axis=1, dtype=np.uint64)
    result: Slots = np.arange(len(vectors))
    ranked = np.sort(hashes)
    shared = ranked[1:][ranked[1:] == ranked[:-1]]
    first: dict[bytes, int] = {}
    for number in np.flatnonzero(np.isin(hashes, shared)).tolist() if len(shared) else ():
        result[number] = first.setdefault(vectors[number].tobytes(), number)
    return result
