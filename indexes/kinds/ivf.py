"""FAISS inverted lists: vectors grouped around trained centres; a search visits a few lists."""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from indexes.errors import ParameterError
from indexes.kinds import vector_index
from indexes.kinds.faiss_index import FaissIndex, load_faiss
from indexes.kinds.scores import Floats, Slots

faiss = load_faiss()

POINTS_PER_CENTRE = 39
"""Smallest number of training points of each centre that FAISS accepts without a warning."""

MAX_POINTS_PER_CENTRE = 64
"""Largest number of training points of each centre: more points improve the centres little and take longer."""

MIN_CODED_VECTORS = 16 * POINTS_PER_CENTRE
"""Least number of vectors to train compressed codes: enough for the smallest codebook and the components' ranges."""

SPARE_CODES = 64
"""Candidates beyond k that are scored exactly, because codes of a byte per component swap the order of near-copies."""

MIN_REFINED = 64
"""A smaller k refines as many candidates as this k: codes are too coarse to trust the first few."""


@dataclass(frozen=True)
class IVFParameters(vector_index.Parameters):
    """Number of lists, and number of lists that a search visits.

    Adding costs N x lists, training up to `MAX_POINTS_PER_CENTRE` x lists x lists: 4 times as many lists made a build
    10 times slower and, at equal recall, a query 10 to 50 % faster.

    Attributes:
        lists: Number of lists; None for sqrt(N). It is lowered to N / 39, the maximum that N points can train.
        probes: Number of visited lists; None for an eighth of the lists, at least 8.
    """

    lists: int | None = None
    probes: int | None = None

    def __post_init__(self) -> None:
        self.check("lists", "probes")


@dataclass(frozen=True)
class IVFPQParameters(IVFParameters):
    """Lists and product-quantization codes.

    Attributes:
        code_bytes: Bytes of each code, a divisor of the vector size; None for the largest divisor up to an eighth of it
            (up to 8 if the size is below 64).
        refine: `refine` times k candidates are scored exactly (k is raised to `MIN_REFINED`).
    """

    code_bytes: int | None = None
    refine: int = 8

    def __post_init__(self) -> None:
        self.check("lists", "probes", "code_bytes", "refine")


class IVFFlatIndex(FaissIndex):
    """Inverted lists of uncompressed vectors."""

    kind: ClassVar[str] = "ivf_flat"
    structure_type: ClassVar[str] = "IndexIVFFlat"
    retrain_growth: ClassVar[float | None] = 2.0
    search_settings: ClassVar[frozenset[str]] = frozenset({"probes"})
    search_ladder: ClassVar[vector_index.Ladder | None] = ("probes", (1, 2, 4, 8, 16, 32, 64, 128, 256))
    parameters_type: ClassVar[type[vector_index.Parameters]] = IVFParameters
    parameters: IVFParameters

    @classmethod
    def resolve_parameters(cls, parameters: Any, count: int, dim: int) -> Any:
        """Fill in `lists` and `probes` for `count` vectors."""
        parameters = super().resolve_parameters(parameters, count, dim)
        maximum = max(1, count // POINTS_PER_CENTRE)
        lists = min(maximum, parameters.lists or round(math.sqrt(count)))
        probes = min(lists, parameters.probes or max(8, math.ceil(lists / 8)))
        return replace(parameters, lists=lists, probes=probes)

    def _make(self) -> Any:
        structure = faiss.IndexIVFFlat(self._centres(), self.dim, self._lists, faiss.METRIC_INNER_PRODUCT)
        return self._prepared(structure)

    def _training(self) -> Floats:
        maximum = MAX_POINTS_PER_CENTRE * self._lists
        if self.count <= maximum:
            return super()._training()
        drawn = np.random.default_rng(self.seed).choice(self.count, maximum, replace=False)
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
    """Inverted lists with one byte for each component: a quarter of the memory. Code scores are within 1 % of exact."""

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
    """Inverted lists of compressed vectors; the final scores use the uncompressed vectors on disk.

    The codebooks have 256 codes if there are enough vectors to train them, else fewer, down to 16.
    """

    kind: ClassVar[str] = "ivf_pq"
    structure_type: ClassVar[str] = "IndexIVFPQ"
    min_vectors: ClassVar[int] = MIN_CODED_VECTORS
    search_settings: ClassVar[frozenset[str]] = frozenset({"probes", "refine"})
    build_ladder: ClassVar[vector_index.Ladder | None] = ("code_bytes", (8, 16, 32))
    parameters_type: ClassVar[type[vector_index.Parameters]] = IVFPQParameters
    parameters: IVFPQParameters

    @classmethod
    def resolve_parameters(cls, parameters: Any, count: int, dim: int) -> Any:
        """Fill in `lists`, `probes` and `code_bytes`. Raises `ParameterError` if `code_bytes` does not divide `dim`."""
        if parameters.code_bytes is not None and dim % parameters.code_bytes:
            raise ParameterError(f"code_bytes must divide the vector size {dim}; got {parameters.code_bytes}")
        code_bytes = parameters.code_bytes or _default_bytes(dim)
        return replace(super().resolve_parameters(parameters, count, dim), code_bytes=code_bytes)

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
    maximum = max(8, dim // 8)
    return max(parts for parts in range(1, min(maximum, dim) + 1) if dim % parts == 0)
