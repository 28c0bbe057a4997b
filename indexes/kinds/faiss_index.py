"""What the FAISS kinds share: FAISS names the candidates, `indexes.kinds.scores` scores and orders them."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import faiss as _faiss
import numpy as np

from indexes.errors import CorruptIndex, EngineError
from indexes.kinds.checks import check_slots
from indexes.kinds.scores import Doubles, Floats, Mask, Slots, error_bound, grid_scores, scan, to_grid, top_k
from indexes.kinds.vector_index import VectorIndex

faiss: Any = _faiss
"""The library, untyped: its stubs leave out half of it."""

FETCH_FACTOR = 4
"""How much further each round looks than the one before."""

ADDED_ROWS = 1 << 16
"""Vectors given to FAISS at once."""


@contextmanager
def faiss_call(doing: str, threads: int | None) -> Iterator[None]:
    """Run FAISS with `threads` threads (None: its own setting) and turn what it raises into `EngineError`."""
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
    """A kind whose candidates FAISS names.

    Rounds: FAISS names some candidates; they are scored and ordered exactly; a query is settled when
    k live ones are there and, for an exact kind, no slot outside can reach the last of them. The unsettled
    look `FETCH_FACTOR` times further, and once everything would be asked for the vectors are scanned instead.
    """

    structure_type: ClassVar[str]
    """Name of the FAISS class."""
    build_threads: ClassVar[int | None] = None
    """Threads of a build unless the caller names a number."""

    _structure: Any = None

    def _make(self) -> Any:
        """An empty, untrained structure for the resolved parameters."""
        raise NotImplementedError

    def _candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        """The structure's own scores and slots (Q, fetch), best first, -1 where it found none.

        `effort` is 1 in the first round and grows; a kind that can look further multiplies by it.
        """
        raise NotImplementedError

    def _training(self) -> Floats:
        """The vectors to train the structure on."""
        return np.ascontiguousarray(self._vectors)

    def _first_fetch(self, k: int) -> int:
        """How many candidates the first round asks for when every slot is live."""
        return k

    def _search(self, queries: Floats, k: int, live: Mask | None) -> tuple[Floats, Slots]:
        scores = np.empty((len(queries), k), dtype=np.float32)
        slots = np.empty((len(queries), k), dtype=np.int64)
        dilution = 1.0 if live is None else self.count / np.count_nonzero(live)
        fetch, effort = math.ceil(self._first_fetch(k) * dilution), 1
        pending = np.arange(len(queries))
        while pending.size and fetch < self.count:
            rough, found = self._rough_candidates(queries[pending], fetch, effort)
            gridded, open_still = to_grid(queries[pending]), []
            for place, query in enumerate(pending):
                kept = found[place][found[place] >= 0]
                kept = kept if live is None else kept[live[kept]]
                ranked, ordered = top_k(grid_scores(gridded[place], to_grid(self._vectors[kept])), kept, k)
                reach = float(rough[place].min()) + error_bound(self.dim)
                if len(ranked) == k and (not self.exact or float(ranked[-1]) > reach):
                    scores[query], slots[query] = ranked, ordered
                else:
                    open_still.append(query)
            pending = np.array(open_still, dtype=np.int64)
            fetch, effort = fetch * FETCH_FACTOR, effort * FETCH_FACTOR
        if pending.size:
            scores[pending], slots[pending] = scan(self._vectors, queries[pending], k, live)
        return scores, slots

    def _candidate_slots(self, query: Floats, k: int, live: Mask | None) -> Slots:
        """What the first round names, where that is enough. Of an exact kind those alone are scored again that rounding
        may have put on the wrong side of the last place, and mostly none is as near to it.
        """
        dilution = 1.0 if live is None else self.count / np.count_nonzero(live)
        fetch = math.ceil(self._first_fetch(k) * dilution)
        if fetch < self.count:
            rough, found = (row[0] for row in self._rough_candidates(query, fetch, 1))
            kept = found >= 0 if live is None else (found >= 0) & live[found]
            scores: Floats = rough[kept]
            slots: Slots = found[kept]
            if len(slots) >= k and not self.exact:
                return slots
            if len(slots) > k:
                last, off = float(scores[k - 1]), 2 * error_bound(self.dim)
                if float(scores[k]) < last - off:
                    return slots[:k]
                exact: Doubles = scores.astype(np.float64)  # what is added to them must not be rounded
                above = exact > last + off
                sure, near = slots[above], slots[~above & (exact >= last - off)]
                if rough[-1] < last - off:
                    gridded = to_grid(query[0])
                    more = top_k(grid_scores(gridded, to_grid(self._vectors[near])), near, k - len(sure))[1]
                    return np.concatenate([sure, more])
        return super()._candidate_slots(query, k, live)

    def _rough_candidates(self, queries: Floats, fetch: int, effort: int) -> tuple[Floats, Slots]:
        """FAISS's scores and slots (Q, n) of the best `fetch` candidates, -1 where there are fewer."""
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
                self._structure = faiss.clone_index(self._structure)  # this one may be another index's too
            self._add_missing()

    def _add_missing(self) -> None:
        """Give the structure the vectors that it does not hold."""
        with faiss_call(f"adding to {self.kind}", self._build_threads()):
            for start in range(self._structure.ntotal, self.count, ADDED_ROWS):
                self._structure.add(np.ascontiguousarray(self._vectors[start : start + ADDED_ROWS]))

    def _write(self, path: Path) -> None:
        with faiss_call(f"writing {path}", None):
            faiss.write_index(self._structure, str(path))

    def _read(self, path: Path) -> None:
        try:
            structure = faiss.read_index(str(path))
        except Exception as error:
            raise CorruptIndex(f"{path}: FAISS cannot read it; build the index again ({error})") from error
        got = (type(structure).__name__, structure.ntotal, structure.d, structure.metric_type)
        must = (self.structure_type, self.count, self.dim, faiss.METRIC_INNER_PRODUCT)
        if got != must:
            raise CorruptIndex(
                f"{path}: must hold (type, count, size, metric) {must}, holds {got}; build the index again"
            )
        self._structure = structure
