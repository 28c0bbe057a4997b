"""Base class of the FAISS kinds: FAISS finds the candidates, `indexes.kinds.scores` scores and orders them."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from indexes.errors import CorruptIndex, EngineError
from indexes.kinds.checks import check_slots
from indexes.kinds.scores import Doubles, Floats, Mask, Slots, error_bound, grid_scores, scan, to_grid, top_k
from indexes.kinds.vector_index import VectorIndex

FETCH_FACTOR = 4
"""Growth of the number of candidates from one round to the next."""

ADDED_ROWS = 1 << 16
"""Vectors passed to FAISS at once."""


def load_faiss() -> Any:
    """Return the library, untyped: its stubs are incomplete. The slow import happens on the first call."""
    import faiss

    return faiss


@contextmanager
def faiss_call(doing: str, threads: int | None) -> Iterator[None]:
    """Run FAISS with `threads` threads (None: its own setting), and convert its exceptions to `EngineError`."""
    faiss = load_faiss()
    before = faiss.omp_get_max_threads()
    if threads is not None:
        faiss.omp_set_num_threads(threads)
    try:
        yield
    except (RuntimeError, AssertionError, ValueError, TypeError, MemoryError) as error:
        raise EngineError(f"FAISS failed while {doing}: {error or type(error).__name__}") from error
    finally:
        faiss.omp_set_num_threads(before)


class FaissIndex(VectorIndex):
    """A kind whose candidates come from FAISS.

    The search runs in rounds. FAISS returns some candidates, which are then scored and ordered exactly. A query is
    complete when k live candidates are found and, for an exact kind, no other slot can reach the score of the last
    one. Incomplete queries fetch `FETCH_FACTOR` times more. When a round would fetch everything, all vectors are
    scanned instead.
    """

    structure_type: ClassVar[str]
    """Name of the FAISS class."""
    build_threads: ClassVar[int | None] = None
    """Number of threads of a build if the caller gives none."""

    _structure: Any = None

    def _make(self) -> Any:
        """Return an empty, untrained structure for the resolved parameters."""
        raise NotImplementedError

    def _candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        """Return the structure's own scores and slots (Q, fetch), best first, padded with -1.

        Args:
            queries: Unit vectors (Q, d).
            fetch: Number of candidates for each query.
            effort: Factor of the search breadth: 1 in the first round, larger in later ones.
        """
        raise NotImplementedError

    def _training(self) -> Floats:
        """Return the vectors to train the structure on."""
        return np.ascontiguousarray(self._vectors)

    def _first_fetch(self, k: int) -> int:
        """Return the number of candidates of the first round if every slot is live."""
        return k

    def _search(self, queries: Floats, k: int, live: Mask | None) -> tuple[Floats, Slots]:
        scores = np.empty((len(queries), k), dtype=np.float32)
        slots = np.empty((len(queries), k), dtype=np.int64)
        dilution = 1.0 if live is None else self.count / np.count_nonzero(live)
        fetch, effort = math.ceil(self._first_fetch(k) * dilution), 1
        pending = np.arange(len(queries))
        while pending.size and fetch < self.count:
            rough, found = self._rough_candidates(queries[pending], fetch, effort)
            gridded, incomplete = to_grid(queries[pending]), []
            for place, query in enumerate(pending):
                named = found[place][found[place] >= 0]
                named = named if live is None else named[live[named]]
                ranked, ordered = top_k(grid_scores(gridded[place], to_grid(self._vectors[named])), named, k)
                reach = float(rough[place].min()) + error_bound(self.dim)
                if len(ranked) == k and (not self.exact or float(ranked[-1]) > reach):
                    scores[query], slots[query] = ranked, ordered
                else:
                    incomplete.append(query)
            pending = np.array(incomplete, dtype=np.int64)
            fetch, effort = fetch * FETCH_FACTOR, effort * FETCH_FACTOR
        if pending.size:
            scores[pending], slots[pending] = scan(self._vectors, queries[pending], k, live)
        return scores, slots

    def _candidate_slots(self, query: Floats, k: int, live: Mask | None) -> Slots:
        """Return the slots of the first round if they suffice.

        An exact kind scores only those slots again that rounding may have put on the wrong side of rank k; usually
        there are none.
        """
        dilution = 1.0 if live is None else self.count / np.count_nonzero(live)
        fetch = math.ceil(self._first_fetch(k) * dilution)
        if fetch < self.count:
            rough, found = (row[0] for row in self._rough_candidates(query, fetch, 1))
            usable = found >= 0 if live is None else (found >= 0) & live[found]
            scores: Floats = rough[usable]
            slots: Slots = found[usable]
            if len(slots) >= k and not self.exact:
                return slots
            if len(slots) > k:
                last, off = float(scores[k - 1]), 2 * error_bound(self.dim)
                if float(scores[k]) < last - off:
                    return slots[:k]
                exact: Doubles = scores.astype(np.float64)  # adding the bound must not round
                above = exact > last + off
                sure, near = slots[above], slots[~above & (exact >= last - off)]
                if rough[-1] < last - off:
                    gridded = to_grid(query[0])
                    more = top_k(grid_scores(gridded, to_grid(self._vectors[near])), near, k - len(sure))[1]
                    return np.concatenate([sure, more])
        return super()._candidate_slots(query, k, live)

    def _rough_candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        """Return FAISS's scores and slots (Q, n) of the best `fetch` candidates, padded with -1."""
        with faiss_call("searching", 1 if len(queries) == 1 else self.threads):
            rough, found = self._candidates(queries, fetch, effort)
        return rough, check_slots(found, self.count, minimum=-1)

    def _build_threads(self) -> int | None:
        return self.build_threads if self.threads is None else self.threads

    def _build(self) -> None:
        with faiss_call(f"building {self.kind}", self._build_threads()):
            self._structure = self._make()
            if not self._structure.is_trained:
                self._structure.train(self._training())
        self._add_missing()

    def _extend_structure(self) -> None:
        if self._structure.ntotal < self.count:
            with faiss_call(f"copying {self.kind}", None):
                self._structure = load_faiss().clone_index(self._structure)  # a copy of this index may use it too
            self._add_missing()

    def _add_missing(self) -> None:
        """Add the vectors that the structure lacks."""
        with faiss_call(f"adding to {self.kind}", self._build_threads()):
            for start in range(self._structure.ntotal, self.count, ADDED_ROWS):
                self._structure.add(np.ascontiguousarray(self._vectors[start : start + ADDED_ROWS]))

    def _write(self, path: Path) -> None:
        with faiss_call(f"writing {path}", None):
            load_faiss().write_index(self._structure, str(path))

    def _read(self, path: Path) -> None:
        faiss = load_faiss()
        try:
            structure = faiss.read_index(str(path))
        except Exception as error:
            raise CorruptIndex(f"{path}: FAISS cannot read it; build the index again ({error})") from error
        got = (type(structure).__name__, structure.ntotal, structure.d, structure.metric_type)
        must = (self.structure_type, self.count, self.dim, faiss.METRIC_INNER_PRODUCT)
        if got != must:
            raise CorruptIndex(
                f"{path}: the structure must have (type, count, size, metric) {must}, got {got}; build the index again"
            )
        self._structure = structure
