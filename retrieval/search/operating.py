"""The operating point of an index: which kind finds the candidates, and how many of them the classifier judges.

It is measured on the catalogue itself, with touches of validation objects that the checkpoint keeps for it. The winner
of a touch is the photo that the classifier ranks first when it judges every one; the winner recall at k is the share of
touches whose winner is among the k candidates.

    neither bound asked for    exact search, and the least k of a ladder with a winner recall of 0.99
    min_recall                 the least k with that recall; approximate kinds are tried where exact search takes
                               longer than judging its candidates, and the fastest point is taken
    max_ms                     the same if search and judging take no longer; else what approximate kind does; else
                               the highest recall within the time, or where nothing is, the fastest with the recall
    both                       recall and time, or where nothing has both, the fastest with the recall

What must be judged to know the winners grows with the catalogue: fewer touches are asked then, and what was measured
stands until a tenth of the photos has changed.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import takewhile
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexes import load_kind
from indexes.kinds.base import Parameters, VectorIndex
from indexes.kinds.choice import ladder
from indexes.kinds.measure import Clock
from indexes.kinds.scores import Floats, Slots
from indexes.kinds.stack import Vectors
from retrieval.console.progress import Bar
from retrieval.errors import BadInput
from retrieval.metrics.binomial import binomial_interval
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.fusion import score_halves

TARGET = 0.99
"""Winner recall where none is asked for."""

FIRST = 500
"""With no more photos than this all are judged, and nothing is measured."""

FEWER = (250, 100, 50, 25, 10)
"""Candidates to try below `FIRST` where time is short."""

WIDER = 4
"""How many times more candidates an approximate kind may take than exact search needs."""

EXACT, APPROXIMATE = ("flat", "exact"), ("ivf_sq8", "hnsw")
"""Kinds that find the best embeddings always; kinds to try where these take too long, the quickest to build first."""

TIMED = 15
LEAST_QUERIES = 50
MEASURING = 3e12
"""Floating-point operations to spend on finding winners: 150 touches over 100,000 halves of 256 numbers."""

STALE = 0.10
"""Share of a catalogue that may change before its operating point is measured again."""


@dataclass(frozen=True)
class Asked:
    """What the user asks of candidate search; None leaves it open. Raises BadInput, or ParameterError for the kind.

    max_ms: for one touch of an opened index, candidate search and judging together.
    """

    kind: str | None = None
    min_recall: float | None = None
    max_ms: float | None = None

    def __post_init__(self) -> None:
        if self.kind is not None:
            load_kind(self.kind)
        if self.min_recall is not None and not 0 < self.min_recall <= 1:
            raise BadInput(f"the least winner recall must lie above 0 and be 1 at most; got {self.min_recall}")
        if self.max_ms is not None and not self.max_ms > 0:
            raise BadInput(f"the longest search must be above 0 ms; got {self.max_ms}")

    @property
    def target(self) -> float:
        """The winner recall to reach."""
        return TARGET if self.min_recall is None else self.min_recall

    @property
    def bounded(self) -> bool:
        """Whether the user asked for recall or time."""
        return self.min_recall is not None or self.max_ms is not None


@dataclass(frozen=True)
class Point:
    """One way to search: what it found of the winners, and median milliseconds of search and of judging.

    k: candidates for one touch. found: of `queries` winners.
    """

    kind: str
    parameters: Parameters
    k: int
    found: int
    queries: int
    search_ms: float
    judge_ms: float

    @property
    def recall(self) -> float:
        """Winner recall."""
        return self.found / self.queries

    @property
    def ms(self) -> float:
        """Milliseconds for one touch."""
        return self.search_ms + self.judge_ms


@dataclass(frozen=True)
class Settled:
    """What to build, why in a sentence, and what the manifest says of it under "candidates" (None: nothing)."""

    kind: str
    parameters: Parameters
    reason: str
    candidates: dict[str, Any] | None


class Bench:
    """A catalogue to measure searches on, and touches whose winners are known.

    vectors (S, d) float32 of norm 1, slots (N,) that say which of them is each photo's, and halves (N, hidden), which
    are read where they lie. Finding the winners judges every photo for every touch; `quiet` shows no progress.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        vectors: Vectors,
        slots: Slots,
        halves: NDArray[np.floating[Any]],
        *,
        quiet: bool = True,
        clock: Clock = time.perf_counter,
    ) -> None:
        self.count, self._clock = len(halves), clock
        self._head, self._halves = checkpoint.matcher.head, halves
        self._touches, self._queries = _queries(checkpoint, self.count)
        used, self._first, places = np.unique(slots, return_index=True, return_inverse=True)
        self._vectors = np.ascontiguousarray(vectors[used])
        self._built: dict[str, VectorIndex] = {}
        self._winners, self.exhaustive_ms = self._find_winners(places, quiet)

    @property
    def queries(self) -> int:
        """How many touches are measured with."""
        return len(self._queries)

    def built(self, kind: str) -> VectorIndex:
        """An index of that kind over the catalogue's distinct embeddings; each is built once."""
        if kind not in self._built:
            self._built[kind] = load_kind(kind).build(self._vectors, threads=torch.get_num_threads())
        return self._built[kind]

    def point(self, index: VectorIndex, k: int) -> Point:
        """Winner recall and time of `index` with `k` candidates. With no fewer than there are photos, all are judged
        and nothing is searched."""
        about = (index.kind, index.parameters, k)
        if k >= self.count:
            return Point(*about, self.queries, self.queries, 0.0, self.exhaustive_ms)
        found = index.search(self._queries, k)[1]
        hits = int((found == self._winners[:, None]).any(axis=1).sum())
        return Point(*about, hits, self.queries, *self.times(index, k))

    def times(self, index: VectorIndex, k: int) -> tuple[float, float]:
        """Median milliseconds of search and of judging, one touch at a time."""
        taken = []
        for query in range(min(TIMED, self.queries)):
            start = self._clock()
            slots = index.search(self._queries[query : query + 1], k)[1][0]
            between = self._clock()
            score_halves(self._head, self._touches[query : query + 1], self._halves, np.sort(self._first[slots]))
            taken.append((between - start, self._clock() - between))
        search, judge = zip(*taken, strict=True)
        return 1e3 * median(search), 1e3 * median(judge)

    def _find_winners(self, slots: Slots, quiet: bool) -> tuple[Slots, float]:
        winners, taken = [], []
        with Bar("measure", self.queries, "touches", quiet=quiet) as bar:
            for touch in self._touches:
                start = self._clock()
                winners.append(slots[int(score_halves(self._head, touch[None], self._halves).argmax())])
                taken.append(self._clock() - start)
                bar.advance()
        return np.array(winners, dtype=np.int64), 1e3 * median(taken)


def needs_measuring(photos: int, asked: Asked) -> bool:
    """Whether there is something to find out: of few photos all are judged, unless that may be too slow."""
    return photos > FIRST or asked.max_ms is not None


def can_measure(checkpoint: Checkpoint) -> bool:
    """Whether the checkpoint keeps touches to measure with, and embeddings that are made from what it keeps."""
    return bool(checkpoint.queries is not None and len(checkpoint.queries)) and checkpoint.matcher.pruner is not None


@torch.inference_mode()
def query_codes(checkpoint: Checkpoint, count: int | None = None) -> tuple[torch.Tensor, Floats]:
    """Halves (Q, hidden) and unit embeddings (Q, d), float32, of the first `count` touches that the checkpoint keeps.
    Raises BadInput where `can_measure` says that there are none."""
    if checkpoint.queries is None or checkpoint.matcher.pruner is None:
        raise BadInput(f"{checkpoint.path} must keep touches to measure with, and a pruner; train it again")
    halves = torch.from_numpy(checkpoint.queries[:count].astype(np.float32))
    return halves, checkpoint.matcher.pruner.touch(halves).numpy()


def _queries(checkpoint: Checkpoint, photos: int) -> tuple[torch.Tensor, Floats]:
    """As many touches as `MEASURING` lets judge every photo, but `LEAST_QUERIES`; a judgement is a product with a
    square matrix."""
    affordable = MEASURING / (2.0 * photos * checkpoint.config.matcher.hidden**2)
    return query_codes(checkpoint, max(LEAST_QUERIES, int(affordable)))


def settle(bench: Bench, asked: Asked) -> Settled:
    """The operating point for what was asked, measured on the bench."""
    tried: list[Point] = []
    taken = next((point for point in _noted(_points(bench, asked), tried) if _ends(point, asked)), None)
    if taken is None:
        taken = _nearest([*tried, *_hurried(bench, asked, tried)], asked)
    candidates = _record(taken, asked, bench)
    return Settled(taken.kind, taken.parameters, sentence(candidates), candidates)


def _noted(points: Iterator[Point], tried: list[Point]) -> Iterator[Point]:
    for point in points:
        tried.append(point)
        yield point


def _points(bench: Bench, asked: Asked) -> Iterator[Point]:
    """Exact search with more and more candidates until the recall is there; then the approximate kinds, if any is to
    be tried, with as many candidates and more."""
    exact_is_allowed = asked.kind in (None, *EXACT)
    exact = bench.built(asked.kind if asked.kind in EXACT else "flat")
    for point in (bench.point(exact, k) for k in _steps(bench.count)):
        if exact_is_allowed:
            yield point
        if point.recall >= asked.target:
            break
    for kind in _approximate_kinds(asked) if point.k < bench.count else ():
        yield from _kind_points(bench, bench.built(kind), asked, least=point.k)
    if not exact_is_allowed:
        yield bench.point(bench.built(str(asked.kind)), bench.count)


def _approximate_kinds(asked: Asked) -> tuple[str, ...]:
    if asked.kind is not None:
        return () if asked.kind in EXACT else (asked.kind,)
    return APPROXIMATE if asked.bounded else ()


def _kind_points(bench: Bench, built: VectorIndex, asked: Asked, least: int) -> Iterator[Point]:
    """Settings are tried only where there is a bound to meet; else the kind's own are taken."""
    steps = [k for k in _steps(bench.count) if k >= least]
    if not asked.bounded:
        yield from (bench.point(built, k) for k in steps)
        return
    for index in ladder(built):
        yield from (bench.point(index, k) for k in steps if k <= WIDER * least)


def _steps(photos: int) -> list[int]:
    doubled = takewhile(lambda k: k < photos, (FIRST << power for power in range(40)))
    return [*doubled, photos]


def _ends(point: Point, asked: Asked) -> bool:
    """Whether nothing more need be tried: it has the recall, and is within the time, or without one not held up by
    the search."""
    if point.recall < asked.target:
        return False
    if asked.max_ms is not None:
        return point.ms <= asked.max_ms
    return asked.min_recall is None or asked.kind is not None or point.search_ms <= point.judge_ms


def _hurried(bench: Bench, asked: Asked, tried: Sequence[Point]) -> Iterator[Point]:
    """With fewer candidates than the recall needs, where the time is short and was all that was asked for."""
    if asked.max_ms is None or asked.min_recall is not None:
        return
    for kind in dict.fromkeys(point.kind for point in tried):
        for index in ladder(bench.built(kind)):
            k = next((k for k in FEWER if sum(bench.times(index, k)) <= asked.max_ms), None)
            if k is not None:
                yield bench.point(index, k)


def _nearest(points: Sequence[Point], asked: Asked) -> Point:
    """Where time alone was asked for, the highest recall within it; else, or where nothing is, the fastest with the
    recall."""
    quick = [point for point in points if asked.max_ms is not None and point.ms <= asked.max_ms]
    if asked.min_recall is None and quick:
        return max(quick, key=lambda point: (point.recall, -point.ms))
    good = [point for point in points if point.recall >= asked.target]
    return min(good, key=lambda point: point.ms)


def _record(point: Point, asked: Asked, bench: Bench) -> dict[str, Any]:
    low, high = binomial_interval(point.found, point.queries)
    return {
        "k": point.k,
        "winner_recall": point.recall,
        "interval": [low, high],
        "queries": point.queries,
        "ms": point.ms,
        "exhaustive_ms": bench.exhaustive_ms,
        "kind": point.kind,
        "parameters": asdict(point.parameters),
        "asked": asdict(asked),
        "photos": bench.count,
        "changed": 0,
    }


def all_judged(photos: int, asked: Asked) -> dict[str, Any]:
    """What the manifest says of a catalogue so small that every photo is judged, unmeasured."""
    return {"k": photos, "winner_recall": 1.0, "queries": 0, "asked": asdict(asked), "photos": photos, "changed": 0}


def kept(previous: Mapping[str, Any] | None, asked: Asked, photos: int, changed: int) -> dict[str, Any] | None:
    """What was measured before, where it was asked for alike and too few of `photos` have changed since to measure
    again; `changed`: in this build."""
    if not previous or not previous.get("queries") or previous["asked"] != asdict(asked):
        return None
    total = previous["changed"] + changed
    if total > STALE * previous["photos"]:
        return None
    every = previous["k"] >= previous["photos"]
    return {**previous, "changed": total, "k": photos if every else min(previous["k"], photos)}


def sentence(candidates: Mapping[str, Any]) -> str:
    """A record in words: what is judged, what of the winners that finds, and whether it is what was asked for."""
    k, photos = candidates["k"], candidates["photos"]
    if not candidates["queries"]:
        return f"The classifier judges all {photos} photos."
    low, high = candidates["interval"]
    found = round(candidates["winner_recall"] * candidates["queries"])
    judged = "every photo" if k >= photos else f"the best {k} of {photos} photos"
    text = (
        f"The classifier judges {judged}: these hold its winner for {found} of {candidates['queries']} validation "
        f"touches (95 % interval {low:.3f} to {high:.3f}), in {candidates['ms']:.3g} ms against "
        f"{candidates['exhaustive_ms']:.3g} ms for all."
    )
    return text + _missed(candidates)


def _missed(candidates: Mapping[str, Any]) -> str:
    asked = candidates["asked"]
    target = TARGET if asked["min_recall"] is None else asked["min_recall"]
    missed = []
    if candidates["winner_recall"] < target:
        missed.append(f"a winner recall of {target:g}")
    if asked["max_ms"] is not None and candidates["ms"] > asked["max_ms"]:
        missed.append(f"{asked['max_ms']:g} ms")
    return f" Nothing measured here reaches {' and '.join(missed)}; this is the nearest." if missed else ""
