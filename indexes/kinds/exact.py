"""Exact search in numpy, the reference for the other kinds.

It scores in float64 and reads all vectors for each search; `flat` returns the same results many times faster.
"""

from typing import ClassVar

from indexes.kinds.scores import Floats, Mask, Slots, scan
from indexes.kinds.vector_index import VectorIndex


class ExactIndex(VectorIndex):
    """Exact search without a search structure."""

    kind: ClassVar[str] = "exact"
    exact: ClassVar[bool] = True
    structure_file: ClassVar[bool] = False

    def _search(self, queries: Floats, k: int, live: Mask | None) -> tuple[Floats, Slots]:
        return scan(self._vectors, queries, k, live)
