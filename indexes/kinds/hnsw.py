"""FAISS graph search (Malkov and Yashunin, arXiv 1603.09320)."""

from dataclasses import dataclass
from typing import Any, ClassVar

from indexes.kinds import vector_index
from indexes.kinds.faiss_index import FaissIndex, load_faiss
from indexes.kinds.scores import Floats, Slots

faiss = load_faiss()


@dataclass(frozen=True)
class HNSWParameters(vector_index.Parameters):
    """Links of each node (`neighbours`, M in the paper), and the search breadth during building and searching."""

    neighbours: int = 32
    ef_construction: int = 80
    ef_search: int = 64

    def __post_init__(self) -> None:
        self.check("neighbours", minimum=2, maximum=vector_index.MAX_COUNT)  # with 1, FAISS ends the process
        self.check("ef_construction", "ef_search", maximum=vector_index.MAX_COUNT)


class HNSWIndex(FaissIndex):
    """A neighbour graph. Duplicate vectors hide the rest of the graph, so the vectors must be distinct.

    By default one thread builds it: with more threads, the graph depends on their timing.
    """

    kind: ClassVar[str] = "hnsw"
    structure_type: ClassVar[str] = "IndexHNSWFlat"
    build_threads: ClassVar[int | None] = 1
    auto_try: ClassVar[bool] = True
    search_settings: ClassVar[frozenset[str]] = frozenset({"ef_search"})
    search_ladder: ClassVar[vector_index.Ladder | None] = ("ef_search", (16, 32, 64, 128, 256, 512, 1000, 2000))
    parameters_type: ClassVar[type[vector_index.Parameters]] = HNSWParameters
    parameters: HNSWParameters

    def _make(self) -> Any:
        structure = faiss.IndexHNSWFlat(self.dim, self.parameters.neighbours, faiss.METRIC_INNER_PRODUCT)
        structure.hnsw.efConstruction = self.parameters.ef_construction
        return structure

    def _add_missing(self) -> None:
        # The random generator is not stored with the graph: seed it by the number of vectors in the graph.
        self._structure.hnsw.rng = faiss.RandomGenerator(self.seed + self._structure.ntotal)
        super()._add_missing()

    def _candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        # FAISS allocates memory for the whole breadth, and more than all vectors cannot be found.
        breadth = min(self.count, max(fetch, self.parameters.ef_search * effort))
        rough, found = self._structure.search(queries, fetch, params=faiss.SearchParametersHNSW(efSearch=breadth))
        return rough, found
