"""FAISS inverted lists: vectors grouped around trained centres, of which a search visits a few."""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from indexes.errors import ParameterError
from indexes.kinds import vector_index
from indexes.kinds.faiss_index import FaissIndex, faiss
from indexes.kinds.scores import Floats, Slots

POINTS_PER_CENTRE = 39
"""Fewest training points for each centre that FAISS accepts without a warning."""

MAX_POINTS_PER_CENTRE = 64
"""Training points for each centre beyond which the centres gain nothing worth the time."""

MIN_CODED_VECTORS = 16 * POINTS_PER_CENTRE
"""Vectors that codes need for their training: enough for the smallest codebook, and for the range of each component."""

SPARE_CODES = 64
"""Candidates beyond k that are scored exactly: with a byte for each component, near-copies change places."""

MIN_REFINED = 64
"""Compressed scores are too coarse to trust their very first: a smaller k refines as many as this one."""


@dataclass(frozen=True)
class IVFParameters(vector_index.Parameters):
    """Number of lists and of lists visited.

    `lists` None takes sqrt(N); any number is lowered to N / 39, what N points can train. Training and adding cost
    N lists: with four times as many a build took ten times as long, and at equal recall a query a tenth to a half less.
    `probes` None takes an eighth of the lists, and at least 8.
    """

    lists: int | None = None
    probes: int | None = None

    def __post_init__(self) -> None:
        self.check("lists", "probes")


@dataclass(frozen=True)
class IVFPQParameters(IVFParameters):
    """Lists, and codes of `code_bytes` bytes per vector; `refine` times k candidates are scored exactly.

    `code_bytes` must divide the vector size; None takes its largest divisor up to an eighth of it (or 8).
    """

    code_bytes: int | None = None
    refine: int = 8

    def __post_init__(self) -> None:
        self.check("lists", "probes", "code_bytes", "refine")


class IVFFlatIndex(FaissIndex):
    """Inverted lists of whole vectors."""

    kind: ClassVar[str] = "ivf_flat"
    structure_type: ClassVar[str] = "IndexIVFFlat"
    retrain_growth: ClassVar[float | None] = 2.0
    search_settings: ClassVar[frozenset[str]] = frozenset({"probes"})
    search_ladder: ClassVar[vector_index.Ladder | None] = ("probes", (1, 2, 4, 8, 16, 32, 64, 128, 256))
    parameters_type: ClassVar[type[vector_index.Parameters]] = IVFParameters
    parameters: IVFParameters

    @classmethod
    def resolve_parameters(cls, asked: Any, count: int, dim: int) -> Any:
        asked = super().resolve_parameters(asked, count, dim)
        most = max(1, count // POINTS_PER_CENTRE)
        lists = min(most, asked.lists or round(math.sqrt(count)))
        probes = min(lists, asked.probes or max(8, math.ceil(lists / 8)))
        return replace(asked, lists=lists, probes=probes)

    def _make(self) -> Any:
        structure = faiss.IndexIVFFlat(self._centres(), self.dim, self._lists, faiss.METRIC_INNER_PRODUCT)
        return self._prepared(structure)

    def _training(self) -> Floats:
        most = MAX_POINTS_PER_CENTRE * self._lists
        if self.count <= most:
            return super()._training()
        drawn = np.random.default_rng(self.seed).choice(self.count, most, replace=False)
        return np.ascontiguousarray(self._vectors[np.sort(drawn)])

    def _centres(self) -> Any:
        return faiss.IndexFlatIP(self.dim)

    @property
    def _lists(self) -> int:
        return self.parameters.lists or 1

    def _prepared(self, structure: Any) -> Any:
        structure.cp.seed = self.seed
        structure.cp.min_points_per_centroid = 1
        return structure

    def _candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        probes = min(self._lists, (self.parameters.probes or 1) * effort)
        settings = faiss.SearchParametersIVF(nprobe=probes)
        rough, found = self._structure.search(queries, fetch, params=settings)
        return rough, found


class IVFSQ8Index(IVFFlatIndex):
    """Inverted lists of vectors with a byte for each component: a quarter of the memory, and scores within 1 %."""

    kind: ClassVar[str] = "ivf_sq8"
    structure_type: ClassVar[str] = "IndexIVFScalarQuantizer"
    auto_try: ClassVar[bool] = True
    min_vectors: ClassVar[int] = MIN_CODED_VECTORS

    def _make(self) -> Any:
        quantizer, metric = faiss.ScalarQuantizer.QT_8bit, faiss.METRIC_INNER_PRODUCT
        centres = self._centres()
        return self._prepared(faiss.IndexIVFScalarQuantizer(centres, self.dim, self._lists, quantizer, metric))

    def _first_fetch(self, k: int) -> int:
        return k + SPARE_CODES


class IVFPQIndex(IVFFlatIndex):
    """Inverted lists of compressed vectors; the uncompressed ones on disk give the final scores.

    The codebooks take 256 codes where there are vectors enough to train them, and fewer down to 16.
    """

    kind: ClassVar[str] = "ivf_pq"
    structure_type: ClassVar[str] = "IndexIVFPQ"
    min_vectors: ClassVar[int] = MIN_CODED_VECTORS
    search_settings: ClassVar[frozenset[str]] = frozenset({"probes", "refine"})
    build_ladder: ClassVar[vector_index.Ladder | None] = ("code_bytes", (8, 16, 32))
    parameters_type: ClassVar[type[vector_index.Parameters]] = IVFPQParameters
    parameters: IVFPQParameters

    @classmethod
    def resolve_parameters(cls, asked: Any, count: int, dim: int) -> Any:
        if asked.code_bytes is not None and dim % asked.code_bytes:
            raise ParameterError(f"code_bytes must divide the vector size {dim}; got {asked.code_bytes}")
        return replace(
            super().resolve_parameters(asked, count, dim), code_bytes=asked.code_bytes or _default_bytes(dim)
        )

    def _make(self) -> Any:
        bits = min(8, int(math.log2(self.count / POINTS_PER_CENTRE)))
        parts = self.parameters.code_bytes or 1
        structure = faiss.IndexIVFPQ(self._centres(), self.dim, self._lists, parts, bits, faiss.METRIC_INNER_PRODUCT)
        structure.pq.cp.seed = self.seed
        structure.pq.cp.min_points_per_centroid = 1
        return self._prepared(structure)

    def _first_fetch(self, k: int) -> int:
        return max(k, MIN_REFINED) * self.parameters.refine


def _default_bytes(dim: int) -> int:
    most = max(8, dim // 8)
    return max(parts for parts in range(1, min(most, dim) + 1) if dim % parts == 0)
