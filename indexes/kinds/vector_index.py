"""The base class of vector indexes, and the checks of vectors."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from indexes.errors import ParameterError, VectorError

Floats: TypeAlias = NDArray[np.float32]
RowNumbers: TypeAlias = NDArray[np.int64]

NORM_TOLERANCE = 1e-3
"""Largest deviation of a norm from 1. Rounding to float32 changes a norm by 1e-7, to float16 by 5e-4."""


class VectorIndex(ABC):
    """Inner-product search over (N, d) float32 unit vectors, in rows 0 to N-1.

    Every kind guarantees:

    * Results are ordered by (-score, row). An exact kind returns the best k; which of several rows with the score of
      rank k it returns is not defined. An approximate kind may miss rows.
    * A score is an inner product in float32. It depends on the batch and on the number of threads by at most
      `score_tolerance(d)`. A kind that compresses vectors returns the scores of its codes.
    * If k is N or more, all rows are scored exactly.
    * Vectors and queries are checked: finite, of unit norm within 1e-3, with d components.

    A subclass implements `_search`; if it has a structure, also `_build`, `save` and `_read`.

    >>> import numpy as np
    >>> index = indexes.build(np.eye(4, dtype=np.float32))
    >>> index.count, index.dim, index.exact
    (4, 4, True)
    >>> index.search(np.eye(4, dtype=np.float32)[2:3], 1)[1].tolist()
    [[2]]
    """

    def __init__(self, vectors: Floats, kind: str) -> None:
        """Store checked arguments; `build` and `load` call this."""
        self.vectors, self.kind = vectors, kind

    @classmethod  # noqa: B027 - most kinds need nothing
    def require(cls, kind: str, count: int, dim: int) -> None:
        """Raise `ParameterError` unless this kind can be built of `count` vectors with `dim` components."""

    @classmethod
    def build(cls, vectors: Floats, kind: str) -> Self:
        """Build an index of vectors.

        Args:
            vectors: Unit vectors (N, d) float32, N >= 1, perhaps memory-mapped.
            kind: Name of the kind.

        Raises:
            VectorError: A vector is invalid, or there is none.
            ParameterError: The kind needs more vectors.
        """
        table = check_unit(vectors)
        if not len(table):
            raise VectorError("an index needs at least one vector; got none")
        cls.require(kind, *table.shape)
        index = cls(table, kind)
        index._build()
        return index

    @classmethod
    def load(cls, path: Path, vectors: Floats, kind: str) -> Self:
        """Load the index that `save` wrote.

        Args:
            path: File of the structure; it is read only if `save` returned True.
            vectors: The same vectors (N, d), perhaps memory-mapped; they are not checked.
            kind: Name of the kind.

        Raises:
            CorruptIndex: The file is unreadable or does not fit the vectors.
        """
        index = cls(vectors, kind)
        index._read(path)
        return index

    @property
    def exact(self) -> bool:
        """Whether a search always finds the best k."""
        return False

    @property
    def count(self) -> int:
        """Number of vectors N."""
        return len(self.vectors)

    @property
    def dim(self) -> int:
        """Number of components d."""
        return int(self.vectors.shape[1])

    def search(self, queries: Floats, k: int) -> tuple[Floats, RowNumbers]:
        """Return the best k rows of each query.

        Args:
            queries: Unit queries (Q, d) float32.
            k: Number of results, at least 1.

        Returns:
            Scores (Q, k') float32 and rows (Q, k') int64; k' = min(k, N). If an approximate kind finds fewer rows for a
            query, the others are -1, with a score of -inf.
        """
        if isinstance(k, bool) or not isinstance(k, int | np.integer) or k < 1:
            raise ParameterError(f"k, the number of results, must be a whole number of at least 1; got {k!r}")
        table, k = check_unit(queries, dim=self.dim, what="query"), min(int(k), self.count)
        if k == self.count:
            scores, rows = table @ self.vectors.T, np.tile(np.arange(k), (len(table), 1))
        else:
            scores, rows = self._search(table, k)
        scores = np.where(rows < 0, np.float32(-np.inf), scores)
        order = np.lexsort((rows, -scores))
        return np.take_along_axis(scores, order, axis=1), np.take_along_axis(rows, order, axis=1)

    def candidates(self, queries: Floats, k: int) -> list[RowNumbers]:
        """Return the rows of `search` for each query, without missing ones."""
        return [rows[rows >= 0] for rows in self.search(queries, k)[1]]

    def save(self, path: Path) -> bool:
        """Write the structure to `path` and return True; return False if the vectors are the whole index."""
        return False

    @abstractmethod
    def _search(self, queries: Floats, k: int) -> tuple[Floats, RowNumbers]:
        """Return scores and rows (Q, k) for checked queries, 1 <= k < N, in any order; row -1 if one is missing."""

    def _build(self) -> None:  # noqa: B027 - nothing to do without a structure
        """Build the structure over `self.vectors`."""

    def _read(self, path: Path) -> None:  # noqa: B027 - nothing to do without a structure
        """Read the structure and check that it fits `self.vectors`."""


def score_tolerance(dim: int) -> float:
    """Return the largest difference of two float32 inner products of the same unit vectors, summed in any orders."""
    return 2 * (dim + 2) * 2.0**-24


def check_unit(vectors: object, *, dim: int | None = None, names: Sequence[str] = (), what: str = "row") -> Floats:
    """Return vectors as a C-contiguous (N, d) float32 array after checking that they are finite unit vectors.

    Args:
        vectors: Array (N, d) float32.
        dim: Required d; None for any.
        names: Names (N,) of the rows in messages; empty for the row numbers.
        what: Word before the name in messages.

    Raises:
        VectorError: A vector has NaN, an infinite component, another norm than 1, or another size.
    """
    if not isinstance(vectors, np.ndarray) or vectors.ndim != 2 or vectors.dtype != np.float32 or not vectors.shape[1]:
        got = " ".join(str(getattr(vectors, name, "")) for name in ("dtype", "shape")).strip()
        raise VectorError(f"{what} vectors must be float32 of shape (count, size); got {got or type(vectors).__name__}")
    if dim is not None and vectors.shape[1] != dim:
        raise VectorError(
            f"{what} vectors must have {dim} components, the size of the index; got {vectors.shape[1]}. "
            "Was the index built with another model?"
        )
    table = np.ascontiguousarray(vectors)
    # in float64, which einsum converts to in small blocks; NaN and infinity give NaN and infinity
    norms = np.sqrt(np.einsum("nd,nd->n", table, table, dtype=np.float64))
    bad = np.flatnonzero(~(np.abs(norms - 1.0) <= NORM_TOLERANCE))
    if len(bad):
        name = names[bad[0]] if names else str(bad[0])
        more = f" ({len(bad) - 1} more like it)" if len(bad) > 1 else ""
        raise VectorError(f"{what} {name!r}: the norm must be 1 within {NORM_TOLERANCE}; got {norms[bad[0]]:.6g}{more}")
    return table
