"""Checks of vectors before they are stored or used as queries."""

from collections.abc import Sequence

import numpy as np

from indexes.errors import AGAIN, CorruptIndex, ParameterError, VectorError
from indexes.kinds.scores import Doubles, Floats, Slots

NORM_TOLERANCE = 1e-3
"""Largest deviation of a norm from 1. Rounding to float32 changes a norm by 1e-7, to float16 by 5e-4."""

BLOCK_ROWS = 8192


def check_unit(
    vectors: object, *, dim: int | None = None, names: Sequence[str] | None = None, what: str = "row"
) -> Floats:
    """Return vectors as a C-contiguous (M, d) float32 array after checking that they are finite unit vectors.

    Args:
        vectors: Array (M, d) float32.
        dim: Required d; None for any.
        names: Names (M,) of the rows in messages; None for the row numbers.
        what: Word before the name in messages.

    Raises:
        VectorError: A vector has NaN, an infinite component, another norm than 1, or another size.
    """
    table = _check_shape(vectors, dim, what)
    if names is not None and len(names) != len(table):
        raise VectorError(f"as many vectors as {what} names are needed; got {len(table)} and {len(names)}")
    norms = row_norms(table)
    good = np.abs(norms - 1.0) <= NORM_TOLERANCE
    if not good.all():
        bad = np.flatnonzero(~good)
        number = int(bad[0])
        name = str(number) if names is None else names[number]
        fault = _fault(table[number], float(norms[number]))
        more = f" ({bad.size - 1} more like it)" if bad.size > 1 else ""
        raise VectorError(f"{what} {name!r}: the norm must be 1 within {NORM_TOLERANCE}; {fault}{more}", name)
    return table


def check_k(k: int) -> int:
    """Return `k` as int. Raises `ParameterError` unless it is a whole number of at least 1."""
    if isinstance(k, bool) or not isinstance(k, int | np.integer) or k < 1:
        raise ParameterError(f"k, the number of results, must be a whole number of at least 1; got {k!r}")
    return int(k)


def check_slots(found: Slots, count: int, minimum: int = 0) -> Slots:
    """Return the slots of a search after checking them.

    Args:
        found: Slots (Q, n) int64.
        count: Number of slots of the index; each result must be below it.
        minimum: Smallest allowed slot; -1 allows the padding of FAISS.

    Raises:
        CorruptIndex: A slot is out of range, or a query has one slot twice.
    """
    if found.size:
        if found.min() < minimum or found.max() >= count:
            odd = found[(found < minimum) | (found >= count)][0]
            raise CorruptIndex(
                f"a search found slot {odd}, but the index has {count}: its structure is damaged; {AGAIN}"
            )
        ranked = np.sort(found, axis=1)
        if ((ranked[:, 1:] == ranked[:, :-1]) & (ranked[:, 1:] >= 0)).any():
            raise CorruptIndex(f"a search found one slot twice: the structure of the index is damaged; {AGAIN}")
    return found


def row_norms(table: Floats) -> Doubles:
    """Return the Euclidean norms (M,) of the rows in float64; rows with NaN or infinity give NaN or infinity."""
    norms = np.empty(len(table), dtype=np.float64)
    for start in range(0, len(table), BLOCK_ROWS):
        block = table[start : start + BLOCK_ROWS].astype(np.float64)
        norms[start : start + BLOCK_ROWS] = np.sqrt(np.einsum("nd,nd->n", block, block))
    return norms


def _check_shape(vectors: object, dim: int | None, what: str) -> Floats:
    if not isinstance(vectors, np.ndarray) or vectors.ndim != 2 or vectors.dtype != np.float32:
        got = " ".join(str(getattr(vectors, name, "")) for name in ("dtype", "shape")).strip()
        raise VectorError(f"{what} vectors must be float32 of shape (count, size); got {got or type(vectors).__name__}")
    if vectors.shape[1] == 0:
        raise VectorError(f"{what} vectors must have at least one component; got shape {vectors.shape}")
    if dim is not None and vectors.shape[1] != dim:
        raise VectorError(
            f"{what} vectors must have {dim} components, the size of the index; got {vectors.shape[1]}. "
            "Was the index built with another model?"
        )
    return np.ascontiguousarray(vectors)


def _fault(row: Floats, norm: float) -> str:
    if np.isnan(row).any():
        return "it has NaN (not a number)"
    if np.isinf(row).any():
        return "it has an infinite component"
    if norm == 0.0:
        return "the vector is zero"
    return f"got {norm:.6g}"
