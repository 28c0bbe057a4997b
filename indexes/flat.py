"""FAISS exact search: the default stored kind."""

from typing import Any, ClassVar

from indexes.faiss_index import FaissIndex, faiss
from indexes.scores import Floats, Slots

SPARE = 16
"""Candidates beyond k in the first round, so that rounding at the last rank rarely needs a second one."""


class FlatIndex(FaissIndex):
    """Every vector is compared in float32, and whatever could be among the best k is scored again exactly."""

    kind: ClassVar[str] = "flat"
    exact: ClassVar[bool] = True
    rebuild_is_cheap: ClassVar[bool] = True
    structure_type: ClassVar[str] = "IndexFlatIP"

    def _make(self) -> Any:
        return faiss.IndexFlatIP(self.dim)

    def _first_fetch(self, k: int) -> int:
        return k + SPARE

    def _candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        rough, found = self._structure.search(queries, fetch)
        return rough, found
