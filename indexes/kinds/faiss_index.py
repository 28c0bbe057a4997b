"""FAISS: exact search, or the structure of a FAISS factory string."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from typing import Any, Self

import numpy as np

from indexes.errors import AGAIN, CorruptIndex, ParameterError, WriteFailed
from indexes.kinds.vector_index import Floats, RowNumbers, VectorIndex

FLAT = "flat"
"""The kind that searches exactly."""
POINTS_PER_CENTRE = 39
"""Smallest number of training vectors of each centre that FAISS accepts without a warning."""
MAX_NUMPY_SCORES = 1 << 14
"""Largest number of scores of an exact search by numpy. It takes less than a millisecond, the import of FAISS 25."""


def load_faiss() -> Any:
    """Return the library, untyped: its stubs are incomplete. The slow import happens on the first call."""
    import faiss

    return faiss


@contextmanager
def _one_thread(is_one: bool) -> Iterator[None]:
    """Run FAISS with one thread if `is_one`, else with its own number."""
    faiss = load_faiss()
    before = faiss.omp_get_max_threads()
    if is_one:
        faiss.omp_set_num_threads(1)
    try:
        yield
    finally:
        faiss.omp_set_num_threads(before)


class FaissIndex(VectorIndex):
    """Search by FAISS.

    The kind is "flat", exact search, which scans the vectors in place. Or it is a factory string of FAISS, perhaps with
    search settings after a semicolon, such as "IVF1024,SQ8;nprobe=32" or "HNSW32;efSearch=64".

    >>> index = indexes.build(vectors, "HNSW16;efSearch=32")
    >>> index.exact, index.search(vectors[:1], 3)[1].shape
    (False, (1, 3))
    """

    _structure: Any = None

    @property
    def exact(self) -> bool:
        """Whether the kind is "flat"."""
        return self.kind == FLAT

    @classmethod
    def require(cls, kind: str, count: int, dim: int) -> None:
        """Raise `ParameterError` unless FAISS knows this kind and can train it on `count` vectors of size `dim`."""
        if kind == FLAT:
            return
        structure = _empty(kind, dim)
        faiss = load_faiss()
        lists = faiss.try_extract_index_ivf(structure)
        inner = structure if lists is None else faiss.downcast_index(lists)
        centres = max(0 if lists is None else lists.nlist, 2**inner.pq.nbits if hasattr(inner, "pq") else 0)
        if count < centres * POINTS_PER_CENTRE:
            raise ParameterError(
                f"the kind {kind} needs at least {centres * POINTS_PER_CENTRE} photos to train {centres} centres; got "
                f"{count}. Use the kind flat, or one with fewer centres"
            )

    def with_settings(self, settings: str) -> Self:
        """Return an index with a copy of the structure and other search settings, such as "nprobe=16"."""
        other = copy(self)
        other.kind = f"{self.kind.partition(';')[0]};{settings}"
        other._structure = load_faiss().clone_index(self._structure)
        load_faiss().ParameterSpace().set_index_parameters(other._structure, settings)
        return other

    def _build(self) -> None:
        if self.exact:
            return
        self._structure = _empty(self.kind, self.dim)
        # The graph of more threads would depend on their timing.
        with _one_thread(hasattr(self._structure, "hnsw")):
            if not self._structure.is_trained:
                self._structure.train(self.vectors)
            self._structure.add(self.vectors)

    def _search(self, queries: Floats, k: int) -> tuple[Floats, RowNumbers]:
        if self.exact and len(queries) * self.count <= MAX_NUMPY_SCORES:
            scores: Floats = queries @ self.vectors.T
            rows: RowNumbers = np.argsort(-scores, axis=1, kind="stable")[:, :k]
            return np.take_along_axis(scores, rows, axis=1), rows
        with _one_thread(len(queries) == 1):
            if self.exact:
                faiss = load_faiss()
                scores, rows = faiss.knn(queries, self.vectors, k, faiss.METRIC_INNER_PRODUCT)
            else:
                scores, rows = self._structure.search(queries, k)
        return scores, rows

    def save(self, path: Path) -> bool:
        """As `VectorIndex.save`."""
        if self._structure is None:
            return False
        try:
            load_faiss().write_index(self._structure, str(path))
        except RuntimeError as error:  # the disk is full
            raise WriteFailed(f"{path}: writing failed ({_reason(error)}); write again") from error
        return True

    def _read(self, path: Path) -> None:
        if self.exact:
            return
        faiss = load_faiss()
        try:
            self._structure = faiss.read_index(str(path))
        except Exception as error:
            raise CorruptIndex(f"{path}: FAISS cannot read it; {AGAIN} ({_reason(error)})") from error
        got = (self._structure.ntotal, self._structure.d, self._structure.metric_type)
        must = (self.count, self.dim, faiss.METRIC_INNER_PRODUCT)
        if got != must:
            raise CorruptIndex(f"{path}: must have (vectors, size, metric) {must}, got {got}; {AGAIN}")


def _empty(kind: str, dim: int) -> Any:
    """Return an empty, untrained structure. Raises `ParameterError` if FAISS does not know the kind."""
    faiss = load_faiss()
    factory, _, settings = kind.partition(";")
    try:
        if re.search(r"HNSW[01](?!\d)", factory):  # FAISS would end the process
            raise ValueError("a graph needs at least 2 neighbours")
        structure = faiss.index_factory(dim, factory, faiss.METRIC_INNER_PRODUCT)
        if settings:
            faiss.ParameterSpace().set_index_parameters(structure, settings)
    except (RuntimeError, ValueError, MemoryError) as error:
        raise ParameterError(
            f"the kind of index must be flat, a factory string of FAISS such as IVF1024,SQ8;nprobe=32 or "
            f"HNSW32;efSearch=64, or module:Class for your own; got {kind!r} ({_reason(error)})"
        ) from error
    return structure


def _reason(error: BaseException) -> str:
    """Return the last part of FAISS's message, without the place in its source."""
    return str(error).rpartition(": ")[2].strip() or type(error).__name__
