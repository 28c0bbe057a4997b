"""FAISS exact search: the default stored kind."""

from typing import ClassVar

from indexes.kinds.faiss_index import FaissIndex, faiss
from indexes.kinds.scores import Floats, Slots

SPARE = 16
"""Candidates beyond k in the first round, so that rounding at the last rank rarely needs a second one."""


class FlatIndex(FaissIndex):
    """Every vector is compared in float32, and whatever could be among the best k is scored again exactly.

    There is no structure: FAISS scans the vectors where they lie.
    """

    kind: ClassVar[str] = "flat"
    exact: ClassVar[bool] = True
    structure_file: ClassVar[bool] = False

    def _build(self) -> None:
        """Nothing: no vector is in a structure, and so all are scanned."""

    def _extend_structure(self) -> None:
        """Nothing, as for `_build`."""

    def _first_fetch(self, k: int) -> int:
        return k + SPARE

    def _candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        rough, found = faiss.knn(queries, self._vectors, fetch, faiss.METRIC_INNER_PRODUCT)
        return rough, found
