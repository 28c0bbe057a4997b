"""FAISS exact search: the default stored kind."""

from typing import ClassVar

from indexes.kinds.faiss_index import FaissIndex, faiss
from indexes.kinds.scores import Floats, Slots

SPARE = 16
"""Candidates beyond k in the first round, so that rounding at rank k rarely requires a second round."""


class FlatIndex(FaissIndex):
    """Exact search: FAISS scores every vector in float32, and possible members of the best k are scored again exactly.

    There is no structure: FAISS scans the vectors in place.
    """

    kind: ClassVar[str] = "flat"
    exact: ClassVar[bool] = True
    structure_file: ClassVar[bool] = False

    def _build(self) -> None:
        """Do nothing: there is no structure."""

    def _extend_structure(self) -> None:
        """Do nothing: there is no structure."""

    def _first_fetch(self, k: int) -> int:
        return k + SPARE

    def _candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        rough, found = faiss.knn(queries, self._vectors, fetch, faiss.METRIC_INNER_PRODUCT)
        return rough, found
