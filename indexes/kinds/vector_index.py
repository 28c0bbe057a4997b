"""The base class of vector indexes, and the checks that every kind shares."""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np

from indexes.errors import ParameterError, VectorError
from indexes.kinds.checks import check_k, check_slots, check_unit
from indexes.kinds.scores import Floats, Mask, Slots

MAX_COUNT = 2**31 - 1
"""Largest 32-bit integer: settings and seeds of FAISS are such integers."""
MAX_THREADS = 4096

Ladder: TypeAlias = tuple[str, tuple[int, ...]]
"""Name of a parameter, and its values to try."""


@dataclass(frozen=True)
class Parameters:
    """Settings of a kind; None is filled in from the data when the index is built."""

    def check(self, *names: str, minimum: int = 1, maximum: float = math.inf) -> None:
        """Check that each named setting is None or a whole number in range.

        Args:
            *names: Names of the settings.
            minimum: Smallest value.
            maximum: Largest value.

        Raises:
            ParameterError: A setting is out of range.
        """
        for name in names:
            value = getattr(self, name)
            if value is not None and not is_whole(value, minimum, maximum):
                limit = f" and at most {maximum}" if maximum < math.inf else ""
                raise ParameterError(f"{name} must be a whole number of at least {minimum}{limit}; got {value!r}")


class VectorIndex(ABC):
    """Inner-product search over (M, d) float32 unit vectors in slots 0..M-1.

    Every kind guarantees:

    * Scores are the inner products of `indexes.kinds.scores`: bitwise equal in every batch, on any number of
      threads, and in every kind.
    * Results are ordered by (-score, slot). An exact kind returns the first k of this order. An approximate kind may
      miss slots, tied ones too, but its scores are exact.
    * A search returns k' = min(k, live slots) results for every query. If a structure finds fewer, it searches
      further and finally scans all vectors. There is no padding.
    * Added vectors and queries are checked: finite, of unit norm within 1e-3, with d components.

    A subclass implements `_search`; if it has a structure, also `_build`, `_extend_structure`, `_read` and `_write`.

    >>> import numpy as np
    >>> index = indexes.load_kind("flat").build(np.eye(4, dtype=np.float32))
    >>> index.count, index.dim, index.exact
    (4, 4, True)
    >>> index.search(np.eye(4, dtype=np.float32)[2:3], 1)[1].tolist()
    [[2]]
    """

    kind: ClassVar[str]
    """Name of the kind, stored in the manifest of an index; by default module:Class."""
    exact: ClassVar[bool] = False
    """Whether a search always finds the true best k."""
    auto_try: ClassVar[bool] = False
    """Whether `retrieve build-index` may choose this kind if a bound for recall or time is set and exact search is too
    slow."""
    retrain_growth: ClassVar[float | None] = None
    """The structure is rebuilt when it has this many times the slots of its last build; None: never."""
    structure_file: ClassVar[bool] = True
    """Whether `save` writes a file; without one, the vectors are the whole index."""
    search_settings: ClassVar[frozenset[str]] = frozenset()
    """Parameters of a search, on which the structure does not depend."""
    search_ladder: ClassVar[Ladder | None] = None
    """The search setting that trades time for recall, and the values to try, the fastest first."""
    build_ladder: ClassVar[Ladder | None] = None
    """The structure parameter that trades memory for recall, and the values that `retrieve frontier` compares."""
    parameters_type: ClassVar[type[Parameters]] = Parameters
    min_vectors: ClassVar[int] = 1
    """Smallest number of vectors for a build."""
    parameters: Parameters

    def __init_subclass__(cls) -> None:
        if "kind" not in vars(cls):
            cls.kind = f"{cls.__module__}:{cls.__qualname__}"

    def __init__(self, vectors: Floats, parameters: Any, seed: int, threads: int | None) -> None:
        """Store checked arguments; `build` and `load` call this."""
        self._vectors = vectors
        self.parameters = parameters
        self.seed = seed
        self.threads = threads

    @classmethod
    def build(
        cls,
        vectors: Floats,
        parameters: Parameters | None = None,
        *,
        names: Sequence[str] | None = None,
        seed: int = 0,
        threads: int | None = None,
    ) -> Self:
        """Build an index of vectors. The same input and seed give the same index.

        Args:
            vectors: Unit vectors (M, d) float32, M >= 1.
            parameters: Settings. Default: the kind's defaults. `.parameters` of the result has every None filled in.
            names: Names (M,) of the rows in messages.
            seed: Seed of all random choices.
            threads: Number of threads; None for the library's own setting.

        Raises:
            VectorError: A vector is invalid, or there is none.
            ParameterError: The parameters are of another kind, or this kind needs more vectors.
        """
        table = check_unit(vectors, names=names)
        if not len(table):
            raise VectorError("an index needs at least one vector; got none")
        return cls.build_checked(table, cls.check_parameters(parameters), seed=seed, threads=threads)

    @classmethod
    def check_parameters(cls, parameters: Parameters | None) -> Parameters:
        """Return the parameters, or the defaults for None. Raises `ParameterError` for those of another kind."""
        checked = cls.parameters_type() if parameters is None else parameters
        if not isinstance(checked, cls.parameters_type):
            raise ParameterError(f"{cls.kind} takes {cls.parameters_type.__name__}; got {type(checked).__name__}")
        return checked

    @classmethod
    def build_checked(
        cls, vectors: Floats, parameters: Parameters, *, seed: int = 0, threads: int | None = None
    ) -> Self:
        """Build an index of vectors (M, d), M >= 1, that are already checked."""
        index = cls(
            vectors, cls.resolve_parameters(parameters, *vectors.shape), check_seed(seed), check_threads(threads)
        )
        index._build()
        return index

    @classmethod
    def load(
        cls,
        path: str | Path | None,
        vectors: Floats,
        parameters: Parameters,
        *,
        seed: int = 0,
        threads: int | None = None,
    ) -> Self:
        """Load the index that `save` wrote.

        Args:
            path: File of the structure; None for a kind without one.
            vectors: The same vectors (M, d), perhaps memory-mapped; they are not checked.
            parameters: The parameters of the saved index.
            seed: The seed of the saved index.
            threads: Number of threads; None for the library's own setting.

        Raises:
            CorruptIndex: The file is unreadable or does not fit the vectors.
        """
        index = cls(vectors, parameters, seed, check_threads(threads))
        if cls.structure_file:
            if path is None:
                raise ParameterError(f"{cls.kind} needs a path to load from; got None")
            index._read(Path(path))
        else:
            index._build()
        return index

    @classmethod
    def parameters_from(cls, settings: Mapping[str, Any]) -> Parameters:
        """Return this kind's parameters from names and values. Raises `ParameterError` for an unknown name."""
        known = [field.name for field in fields(cls.parameters_type)]
        unknown = sorted(set(settings) - set(known))
        if unknown:
            raise ParameterError(
                f"{cls.kind} has the settings {', '.join(known) or '(none)'}; got {', '.join(unknown)}"
            )
        return cls.parameters_type(**settings)

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self._vectors)

    @property
    def dim(self) -> int:
        """Number of components d."""
        return int(self._vectors.shape[1])

    @property
    def vectors(self) -> Floats:
        """The vectors (M, d); do not write to them."""
        return self._vectors

    def settings(self) -> dict[str, Any]:
        """Return the parameters as a JSON object."""
        return asdict(self.parameters)

    def search(self, queries: Floats, k: int, live: Mask | None = None) -> tuple[Floats, Slots]:
        """Return the best k slots of each query.

        Args:
            queries: Unit queries (Q, d) float32.
            k: Number of results, at least 1.
            live: Mask (M,) of the slots to search; None for all.

        Returns:
            Scores (Q, k') float32 and slots (Q, k') int64; k' = min(k, number of live slots).
        """
        table, count = self._check_query(queries, k, live)
        if count == 0 or not len(table):
            shape = (len(table), count)
            return np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.int64)
        scores, slots = self._search(table, count, live)
        return scores, check_slots(slots, self.count)

    def candidates(self, queries: Floats, k: int, live: Mask | None = None) -> list[Slots]:
        """Return candidate slots for each query, unordered and without scores, for a caller that reranks.

        An exact kind returns the k' slots of `search`. An approximate kind returns k' or more: the best by the scores
        of its structure. This is faster than `search`, because few slots are scored exactly.

        Args:
            queries: Unit queries (Q, d) float32.
            k: Number of slots, at least 1.
            live: Mask (M,) of the slots to search; None for all.
        """
        table, count = self._check_query(queries, k, live)
        if count == 0:
            return [np.empty(0, dtype=np.int64) for _ in table]
        found = [self._candidate_slots(query[None], count, live) for query in table]
        for slots in found:
            check_slots(slots[None], self.count)
        return found

    def _check_query(self, queries: Floats, k: int, live: Mask | None) -> tuple[Floats, int]:
        """Return the checked queries, and the number of results of each."""
        k = check_k(k)
        table = check_unit(queries, dim=self.dim, what="query")
        if live is not None and (live.shape != (self.count,) or live.dtype != np.bool_):
            raise ParameterError(f"live must be bool of shape ({self.count},); got {live.dtype} {live.shape}")
        return table, min(k, self.count if live is None else int(np.count_nonzero(live)))

    def add(self, vectors: Floats, *, names: Sequence[str] | None = None) -> None:
        """Append vectors (F, d) as slots M..M+F-1.

        Args:
            vectors: Unit vectors (F, d) float32; F may be 0.
            names: Names (F,) of the rows in messages.
        """
        fresh = check_unit(vectors, dim=self.dim, names=names)
        if len(fresh):
            self.grow(np.concatenate([self._vectors, fresh]))

    def grow(self, vectors: Floats) -> None:
        """Replace the vectors with checked ones (M', d), M' >= M, whose first M rows are those of this index."""
        self._vectors = vectors
        self._extend_structure()

    def save(self, path: str | Path) -> bool:
        """Write the structure to `path` and return True; return False for a kind without a structure."""
        if self.structure_file:
            self._write(Path(path))
        return self.structure_file

    def copy(self) -> Self:
        """Return an index whose `add` and `grow` do not change this one. The vectors are shared."""
        return copy.copy(self)

    def with_settings(self, **settings: Any) -> Self:
        """Return an index with the same structure and other search settings, such as `with_settings(ef_search=128)`.

        Args:
            **settings: New values of search settings (`search_settings`).

        Raises:
            ParameterError: A setting requires a new build.
        """
        fixed = sorted(set(settings) - self.search_settings)
        if fixed:
            can = ", ".join(sorted(self.search_settings)) or "nothing"
            raise ParameterError(f"{self.kind} can change {can} without a new build; got {', '.join(fixed)}")
        other = copy.copy(self)
        other.parameters = replace(self.parameters, **settings)
        return other

    def search_variants(self) -> Iterator[Self]:
        """Yield the same structure with each value of `search_ladder`; without a `search_ladder`, yield this index."""
        if self.search_ladder is None:
            yield self
            return
        setting, values = self.search_ladder
        for value in values:
            yield self.with_settings(**{setting: value})

    @classmethod
    def resolve_parameters(cls, parameters: Any, count: int, dim: int) -> Any:
        """Return the parameters with every None filled in.

        Args:
            parameters: Parameters of this kind.
            count: Number of vectors.
            dim: Number of components of a vector.

        Raises:
            ParameterError: This kind needs more vectors.
        """
        if count < cls.min_vectors:
            raise ParameterError(f"{cls.kind} needs {cls.min_vectors} or more vectors to train its codes; got {count}")
        return parameters

    @abstractmethod
    def _search(self, queries: Floats, k: int, live: Mask | None) -> tuple[Floats, Slots]:
        """Return the result of `search` for checked queries, 1 <= k <= live slots."""

    def _candidate_slots(self, query: Floats, k: int, live: Mask | None) -> Slots:
        """Return the result of `candidates` for one checked query (1, d), 1 <= k <= live slots."""
        slots: Slots = self._search(query, k, live)[1][0]
        return slots

    def _build(self) -> None:  # noqa: B027 - nothing to do without a structure
        """Build the structure over `self._vectors`."""

    def _extend_structure(self) -> None:  # noqa: B027 - nothing to do without a structure
        """Extend the structure to the new vectors at the end of `self._vectors`."""

    def _read(self, path: Path) -> None:
        """Read the structure and check that it fits `self._vectors`."""
        raise NotImplementedError

    def _write(self, path: Path) -> None:
        """Write the structure."""
        raise NotImplementedError


def check_threads(threads: int | None) -> int | None:
    """Return `threads`. Raises `ParameterError` unless it is None or a whole number from 1 to `MAX_THREADS`."""
    if threads is not None and not is_whole(threads, 1, MAX_THREADS):
        raise ParameterError(f"threads must be a whole number from 1 to {MAX_THREADS}, or left out; got {threads!r}")
    return threads


def check_seed(seed: int) -> int:
    """Return `seed`. Raises `ParameterError` unless it is a whole number from 0 to `MAX_COUNT`."""
    if not is_whole(seed, 0, MAX_COUNT):
        raise ParameterError(f"a seed must be a whole number from 0 to {MAX_COUNT}; got {seed!r}")
    return seed


def is_whole(value: object, minimum: int, maximum: float) -> bool:
    """Whether a value is a whole number from `minimum` to `maximum`."""
    return isinstance(value, int) and not isinstance(value, bool) and minimum <= value <= maximum
