"""What searches find of a catalogue, and how long they take: the measurements that an operating point is chosen by."""

import copy
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexes import KINDS, load_kind
from indexes.kinds.measure import Clock, query_ms, recall_against_exact, sample_queries
from indexes.kinds.scores import Floats, Slots
from indexes.kinds.vector_index import Parameters, VectorIndex
from retrieval.console.progress import Bar
from retrieval.errors import BadInput
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.fusion import score_partials

EXHAUSTIVE_LIMIT = 500
"""With no more photos than this all are judged, and nothing is measured."""

SHORT_LADDER = (250, 100, 50, 25, 10)
"""Candidates to try below `EXHAUSTIVE_LIMIT` where time is short."""

TIMED_QUERIES = 15
MIN_QUERIES = 50
MEASUREMENT_FLOPS = 3e12
"""Floating-point operations to spend on finding winners: 150 touches over 100,000 halves of 256 numbers."""

NEIGHBOURS, DRAWN_QUERIES = 10, 64
"""Neighbours to find of each query, and queries to draw, where the checkpoint keeps no touches."""


@dataclass(frozen=True)
class SearchPoint:
    """One way to search: what it found, and median milliseconds of search and of judging.

    k: candidates for one touch. found: of `queries` winners, or nearest neighbours.
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
        """Share of what there was to find."""
        return self.found / self.queries

    @property
    def ms(self) -> float:
        """Milliseconds of search and judging together, for one touch."""
        return self.search_ms + self.rerank_ms


class SearchBench(ABC):
    """A catalogue to measure searches on: `count` photos with the distinct vectors (S, d) float32 of norm 1.

    steps: numbers of candidates to try, ascending. queries: how much there is to find. exhaustive_ms: for one touch
    where every photo is judged and nothing is searched.
    """

    steps: Sequence[int]
    queries: int
    exhaustive_ms: float

    def __init__(self, count: int, vectors: Floats) -> None:
        self.count, self._vectors = count, np.ascontiguousarray(vectors)
        self._built: dict[str, VectorIndex] = {}

    def built(self, kind: str) -> VectorIndex:
        """An index of that kind over the distinct embeddings; each is built once."""
        if kind not in self._built:
            self._built[kind] = load_kind(kind).build(self._vectors, threads=torch.get_num_threads())
        return self._built[kind]

    def kinds_to_try(self) -> list[str]:
        """Kinds to try, unasked, where exact search takes too long: those that can be built, the quickest first."""
        return [
            name
            for name in KINDS.names()
            if load_kind(name).auto_try and load_kind(name).min_vectors <= len(self._vectors)
        ]

    @abstractmethod
    def point(self, index: VectorIndex, k: int) -> SearchPoint:
        """What `index` finds with `k` candidates, and in what time."""

    @abstractmethod
    def times(self, index: VectorIndex, k: int) -> tuple[float, float]:
        """Median milliseconds of search and of judging, one touch at a time."""


class ExhaustiveBench(SearchBench):
    """Touches whose winners are known, to be found among the candidates.

    vectors (S, d), slots (N,) that say which of them is each photo's, and halves (N, half), which are read where they
    lie. Finding the winners judges every photo for every touch; `quiet` shows no progress.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        vectors: Floats,
        slots: Slots,
        partials: NDArray[np.floating[Any]],
        *,
        quiet: bool = True,
        clock: Clock = time.perf_counter,
    ) -> None:
        used, self._first, places = np.unique(slots, return_index=True, return_inverse=True)
        super().__init__(len(partials), vectors[used])
        self.steps = candidate_steps(self.count)
        # ShardResult, and timed, as searches do: on the processor, wherever the towers run.
        self._head, self._partials, self._clock = copy.deepcopy(checkpoint.matcher.head).cpu(), partials, clock
        self._touches, self._queries = _queries(checkpoint, self.count)
        self.queries = len(self._queries)
        self._top1, self.exhaustive_ms = self._find_exhaustive_top1(places, quiet)

    def point(self, index: VectorIndex, k: int) -> SearchPoint:
        """Winner recall and time of `index` with `k` candidates. With no fewer than there are photos, all are judged
        and nothing is searched.
        """
        about = (index.kind, index.parameters, k)
        if k >= self.count:
            return SearchPoint(*about, self.queries, self.queries, 0.0, self.exhaustive_ms)
        found = index.candidates(self._queries, k)
        hits = sum(winner in slots for winner, slots in zip(self._top1, found, strict=True))
        return SearchPoint(*about, hits, self.queries, *self.times(index, k))

    def times(self, index: VectorIndex, k: int) -> tuple[float, float]:
        """Median milliseconds of search and of judging, one touch at a time."""
        taken = []
        for query in range(min(TIMED_QUERIES, self.queries)):
            start = self._clock()
            slots = index.candidates(self._queries[query : query + 1], k)[0]
            between = self._clock()
            score_partials(self._head, self._touches[query : query + 1], self._partials, np.sort(self._first[slots]))
            taken.append((between - start, self._clock() - between))
        search, judge = zip(*taken, strict=True)
        return 1e3 * median(search), 1e3 * median(judge)

    def _find_exhaustive_top1(self, slots: Slots, quiet: bool) -> tuple[Slots, float]:
        winners, taken = [], []
        with Bar("measure", self.queries, "touches", quiet=quiet) as bar:
            for touch in self._touches:
                start = self._clock()
                winners.append(slots[int(score_partials(self._head, touch[None], self._partials).argmax())])
                taken.append(self._clock() - start)
                bar.advance()
        return np.array(winners, dtype=np.int64), 1e3 * median(taken)


class NeighbourBench(SearchBench):
    """Drawn queries (Q, d) near the vectors (S, d), and their nearest neighbours to be found. Judging is not timed."""

    steps = (NEIGHBOURS,)
    queries = NEIGHBOURS * DRAWN_QUERIES
    exhaustive_ms = float("nan")

    def __init__(self, vectors: Floats, clock: Clock = time.perf_counter) -> None:
        super().__init__(len(vectors), vectors)
        self._drawn, self._clock = sample_queries(self._vectors, DRAWN_QUERIES), clock

    def point(self, index: VectorIndex, k: int) -> SearchPoint:
        """Recall of the nearest `k` neighbours, and the time of a search for them."""
        recall = 1.0 if index.exact else recall_against_exact(index, self._drawn, k)
        return SearchPoint(
            index.kind, index.parameters, k, round(recall * self.queries), self.queries, *self.times(index, k)
        )

    def times(self, index: VectorIndex, k: int) -> tuple[float, float]:
        """Median milliseconds of search, and none of judging."""
        return query_ms(index, self._drawn, k, clock=self._clock), 0.0


def candidate_steps(photos: int) -> list[int]:
    """Numbers of candidates to try for so many photos: `EXHAUSTIVE_LIMIT`, doubled again and again, and all."""
    doubled = takewhile(lambda k: k < photos, (EXHAUSTIVE_LIMIT << power for power in range(40)))
    return [*doubled, photos]


def can_measure(checkpoint: Checkpoint) -> bool:
    """Whether the checkpoint keeps touches to measure with, and embeddings that are made from what it keeps."""
    return (
        bool(checkpoint.queries is not None and len(checkpoint.queries))
        and checkpoint.matcher.candidate_encoder is not None
    )


@torch.inference_mode()
def query_codes(checkpoint: Checkpoint, count: int | None = None) -> tuple[torch.Tensor, Floats]:
    """Partials (Q, half) and unit embeddings (Q, d), float32, of the first `count` touches that the checkpoint keeps.
    Raises BadInput where `can_measure` says that there are none.
    """
    if checkpoint.queries is None or checkpoint.matcher.candidate_encoder is None:
        raise BadInput(f"{checkpoint.path} must keep touches to measure with, and a candidate_encoder; train it again")
    partials, candidate_encoder = (
        torch.from_numpy(checkpoint.queries[:count].astype(np.float32)),
        checkpoint.matcher.candidate_encoder,
    )
    return partials, candidate_encoder.touch(partials.to(next(candidate_encoder.parameters()).device)).cpu().numpy()


def _queries(checkpoint: Checkpoint, photos: int) -> tuple[torch.Tensor, Floats]:
    """The halves and embeddings of as many touches as may judge every photo within `MEASUREMENT_FLOPS` operations (a judgement
    is a product with a square matrix), but of `MIN_QUERIES` at least.
    """
    affordable = MEASUREMENT_FLOPS / (2.0 * photos * checkpoint.config.matcher.hidden**2)
    return query_codes(checkpoint, max(MIN_QUERIES, int(affordable)))
