"""Exact search, by numpy in small indexes and by FAISS in others: the default stored kind."""

from typing import ClassVar

import numpy as np

from indexes.kinds.faiss_index import FaissIndex, load_faiss
from indexes.kinds.scores import Floats, Slots

SPARE = 16
"""Candidates beyond k in the first round, so that rounding at rank k rarely requires a second round."""
MAX_NUMPY_SCORES = 1 << 14
"""Largest number of scores of a search by numpy. It takes less than a millisecond, the import of FAISS 25 of them."""


class FlatIndex(FaissIndex):
    """Exact search: every vector is scored in float32, and possible members of the best k are scored again exactly.

    There is no structure: numpy or FAISS scans the vectors in place.
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

    def _rough_candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        if len(queries) * self.count > MAX_NUMPY_SCORES:
            return super()._rough_candidates(queries, fetch, effort)
        scores: Floats = queries @ self._vectors.T
        best: Slots = np.argsort(-scores, axis=1)[:, :fetch]
        return np.take_along_axis(scores, best, axis=1), best

    def _candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        faiss = load_faiss()
        rough, found = faiss.knn(queries, self._vectors, fetch, faiss.METRIC_INNER_PRODUCT)
        return rough, found
