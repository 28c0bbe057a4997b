"""Measurements of candidate search on a catalogue, agreement and time, from which the operating point is chosen."""

import copy
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from statistics import median

import numpy as np
import torch

from indexes import KINDS, load_kind
from indexes.kinds.measure import Clock, query_ms, recall_against_exact, sample_queries
from indexes.kinds.scores import Floats, Slots
from indexes.kinds.vector_index import Parameters, VectorIndex
from retrieval.console.progress import Bar
from retrieval.errors import BadInput
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.fusion import score_partials
from retrieval.model.stored_partials import Partials

EXHAUSTIVE_LIMIT = 500
"""Up to this number of photos, all are scored and nothing is measured."""

SHORT_LADDER = (250, 100, 50, 25, 10)
"""Numbers of candidates below `EXHAUSTIVE_LIMIT`, tried if the time bound is short."""

TIMED_QUERIES = 15
MIN_QUERIES = 50
MEASUREMENT_FLOPS = 3e12
"""Floating-point operations for exhaustive search: enough for 228 touches over 100,000 photos with `hidden` = 256."""

NEIGHBOURS, DRAWN_QUERIES = 10, 64
"""Neighbours to find for each query, and queries to draw, if the checkpoint stores no touches."""


@dataclass(frozen=True)
class SearchPoint:
    """One setting of candidate search with its measurements.

    Attributes:
        kind: Kind of index.
        parameters: Its parameters.
        k: Number of candidates for one touch.
        found: Number of exhaustive top-1 photos, or of nearest neighbours, among the candidates.
        queries: Number of touches, or of neighbours to find.
        search_ms: Median milliseconds of candidate search for one touch.
        rerank_ms: Median milliseconds of reranking.
    """

    kind: str
    parameters: Parameters
    k: int
    found: int
    queries: int
    search_ms: float
    rerank_ms: float

    @property
    def recall(self) -> float:
        """Agreement with exhaustive search at rank 1, or recall of the nearest neighbours."""
        return self.found / self.queries

    @property
    def ms(self) -> float:
        """Milliseconds of candidate search and reranking for one touch."""
        return self.search_ms + self.rerank_ms


class SearchBench(ABC):
    """A catalogue on which searches are measured.

    Attributes:
        count: Number of photos.
        steps: Numbers of candidates to try, ascending.
        queries: Number of touches, or of neighbours to find.
        exhaustive_ms: Median milliseconds of scoring every photo for one touch.
    """

    steps: Sequence[int]
    queries: int
    exhaustive_ms: float

    def __init__(self, count: int, vectors: Floats) -> None:
        """Take the number of photos and their distinct unit vectors (S, d) float32."""
        self.count, self._vectors = count, np.ascontiguousarray(vectors)
        self._indexes: dict[str, VectorIndex] = {}

    def index_of_kind(self, kind: str) -> VectorIndex:
        """Return an index of that kind over the distinct embeddings, built on first use."""
        if kind not in self._indexes:
            self._indexes[kind] = load_kind(kind).build(self._vectors, threads=torch.get_num_threads())
        return self._indexes[kind]

    def kinds_to_try(self) -> list[str]:
        """Return the kinds to try if exact search takes too long, the fastest to build first."""
        return [
            name
            for name in KINDS.names()
            if load_kind(name).auto_try and load_kind(name).min_vectors <= len(self._vectors)
        ]

    @abstractmethod
    def point(self, index: VectorIndex, k: int) -> SearchPoint:
        """Measure `index` with `k` candidates."""

    @abstractmethod
    def times(self, index: VectorIndex, k: int) -> tuple[float, float]:
        """Return the median milliseconds of candidate search and of reranking, one touch at a time."""


class ExhaustiveBench(SearchBench):
    """Touches with known exhaustive top-1 photos, from scoring every photo for every touch.

    Args:
        checkpoint: The model, with the touches that it stores to measure with.
        vectors: Distinct unit embeddings (S, d) float32.
        slots: Row of `vectors` of each photo (N,).
        partials: Partial activations (N, partial_width) of the photos, perhaps memory-mapped.
        quiet: Show no progress.
        clock: Source of the time in seconds.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        vectors: Floats,
        slots: Slots,
        partials: Partials,
        *,
        quiet: bool = True,
        clock: Clock = time.perf_counter,
    ) -> None:
        used, self._first, places = np.unique(slots, return_index=True, return_inverse=True)
        super().__init__(len(partials), vectors[used])
        self.steps = candidate_steps(self.count)
        # Scored and timed on the CPU as in searches, even if the towers run on a GPU.
        self._head, self._partials, self._clock = copy.deepcopy(checkpoint.matcher.head).cpu(), partials, clock
        self._touches, self._queries = _queries(checkpoint, self.count)
        self.queries = len(self._queries)
        self._top1, self.exhaustive_ms = self._find_exhaustive_top1(places, quiet)

    def point(self, index: VectorIndex, k: int) -> SearchPoint:
        """Measure agreement at rank 1 and time with `k` candidates; if k >= count, all are scored without a search."""
        about = (index.kind, index.parameters, k)
        if k >= self.count:
            return SearchPoint(*about, self.queries, self.queries, 0.0, self.exhaustive_ms)
        found = index.candidates(self._queries, k)
        hits = sum(top1 in slots for top1, slots in zip(self._top1, found, strict=True))
        return SearchPoint(*about, hits, self.queries, *self.times(index, k))

    def times(self, index: VectorIndex, k: int) -> tuple[float, float]:
        """Return the median milliseconds of candidate search and of reranking, one touch at a time."""
        taken = []
        for query in range(min(TIMED_QUERIES, self.queries)):
            start = self._clock()
            slots = index.candidates(self._queries[query : query + 1], k)[0]
            between = self._clock()
            score_partials(self._head, self._touches[query : query + 1], self._partials, np.sort(self._first[slots]))
            taken.append((between - start, self._clock() - between))
        search, rerank = zip(*taken, strict=True)
        return 1e3 * median(search), 1e3 * median(rerank)

    def _find_exhaustive_top1(self, slots: Slots, quiet: bool) -> tuple[Slots, float]:
        top1, taken = [], []
        with Bar("measure", self.queries, "touches", quiet=quiet) as bar:
            for touch in self._touches:
                start = self._clock()
                top1.append(slots[int(score_partials(self._head, touch[None], self._partials).argmax())])
                taken.append(self._clock() - start)
                bar.advance()
        return np.array(top1, dtype=np.int64), 1e3 * median(taken)


class NeighbourBench(SearchBench):
    """Random queries near the vectors (S, d), and their nearest neighbours. Reranking is not timed."""

    steps = (NEIGHBOURS,)
    queries = NEIGHBOURS * DRAWN_QUERIES
    exhaustive_ms = float("nan")

    def __init__(self, vectors: Floats, clock: Clock = time.perf_counter) -> None:
        super().__init__(len(vectors), vectors)
        self._drawn, self._clock = sample_queries(self._vectors, DRAWN_QUERIES), clock

    def point(self, index: VectorIndex, k: int) -> SearchPoint:
        """Measure the recall of the nearest `k` neighbours and the time of a search."""
        recall = 1.0 if index.exact else recall_against_exact(index, self._drawn, k)
        return SearchPoint(
            index.kind, index.parameters, k, round(recall * self.queries), self.queries, *self.times(index, k)
        )

    def times(self, index: VectorIndex, k: int) -> tuple[float, float]:
        """Return the median milliseconds of a search, and 0 for reranking."""
        return query_ms(index, self._drawn, k, clock=self._clock), 0.0


def candidate_steps(photos: int) -> list[int]:
    """Return the numbers of candidates to try: `EXHAUSTIVE_LIMIT`, its doubles below `photos`, and `photos`."""
    doubled = takewhile(lambda k: k < photos, (EXHAUSTIVE_LIMIT << power for power in range(40)))
    return [*doubled, photos]


def can_measure(checkpoint: Checkpoint) -> bool:
    """Whether the checkpoint has touches to measure with, and a candidate encoder that embeds them."""
    return (
        bool(checkpoint.queries is not None and len(checkpoint.queries))
        and checkpoint.matcher.candidate_encoder is not None
    )


@torch.inference_mode()
def query_codes(checkpoint: Checkpoint, count: int | None = None) -> tuple[torch.Tensor, Floats]:
    """Return partial activations and embeddings of the touches that a checkpoint stores to measure with.

    Args:
        checkpoint: The model.
        count: Number of touches; None for all.

    Returns:
        Partial activations (Q, partial_width) and unit embeddings (Q, d), float32.

    Raises:
        BadInput: The checkpoint stores no touches or has no candidate encoder (`can_measure`).
    """
    if checkpoint.queries is None or checkpoint.matcher.candidate_encoder is None:
        raise BadInput(
            f"{checkpoint.path} must have touches to measure with and a candidate encoder; train it again with "
            "`retrieve train` (a preset with candidate_width above 0)"
        )
    partials, candidate_encoder = (
        torch.from_numpy(checkpoint.queries[:count].astype(np.float32)),
        checkpoint.matcher.candidate_encoder,
    )
    pooled = partials[:, : checkpoint.config.matcher.pooled_width]
    return partials, candidate_encoder.touch(pooled.to(next(candidate_encoder.parameters()).device)).cpu().numpy()


def _queries(checkpoint: Checkpoint, photos: int) -> tuple[torch.Tensor, Floats]:
    """Return `query_codes` of some touches: as many as can score every photo within `MEASUREMENT_FLOPS`.

    At least `MIN_QUERIES` are used. One score is a product with a square matrix: 2 hidden^2 operations.
    """
    affordable = MEASUREMENT_FLOPS / (2.0 * photos * checkpoint.config.matcher.hidden**2)
    return query_codes(checkpoint, max(MIN_QUERIES, int(affordable)))
