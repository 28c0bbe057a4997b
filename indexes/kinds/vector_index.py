"""The contract of a vector index, and the checks that every kind shares."""

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
"""FAISS counts in 32 bits."""
MAX_THREADS = 4096

Ladder: TypeAlias = tuple[str, tuple[int, ...]]
"""The name of a parameter, and values of it to try."""


@dataclass(frozen=True)
class Parameters:
    """Settings of a kind; None means "chosen from the data when the index is built"."""

    def check(self, *names: str, minimum: int = 1, maximum: float = math.inf) -> None:
        """Each named setting is None or a whole number from `minimum` to `maximum`, or `ParameterError`."""
        for name in names:
            value = getattr(self, name)
            if value is not None and not is_whole(value, minimum, maximum):
                limit = f" and at most {maximum}" if maximum < math.inf else ""
                raise ParameterError(f"{name} must be a whole number of at least {minimum}{limit}; got {value!r}")


class VectorIndex(ABC):
    """Inner-product search over (M, d) float32 unit vectors in slots 0..M-1.

    What holds for every kind:

    * Scores are the inner products of `indexes.kinds.scores`: equal bit for bit in every batch, on any
      number of threads, and in every kind.
    * Results are ordered by (-score, slot). An exact kind returns the first k of that order, ties at the last
      rank included; an approximate kind may miss slots, a tie partner among them, but scores exactly
      those it finds.
    * A search returns k' = min(k, live slots) results for every query, of every kind: where a structure finds
      fewer, it looks further and in the end scans. There is no padding.
    * Vectors are checked when added and when searched for: finite, of unit norm within 1e-3, of d components.

    A subclass writes `_search`, and the structure's `_build`, `_extend_structure`, `_read`, `_write` where it has one.

    >>> import numpy as np
    >>> index = indexes.load_kind("flat").build(np.eye(4, dtype=np.float32))
    >>> index.count, index.dim, index.exact
    (4, 4, True)
    >>> index.search(np.eye(4, dtype=np.float32)[2:3], 1)[1].tolist()
    [[2]]
    """

    kind: ClassVar[str]
    """Its name, which the manifest of an index keeps; module:Class where a subclass says none."""
    exact: ClassVar[bool] = False
    """Whether a search always finds the true best k."""
    auto_try: ClassVar[bool] = False
    """Whether `retrieve build-index` tries this kind, unasked, where exact search takes too long."""
    retrain_growth: ClassVar[float | None] = None
    """Growth, as a multiple of the trained size, beyond which to build anew; None: any."""
    structure_file: ClassVar[bool] = True
    """Whether `save` writes a file; without one the vectors alone are the index."""
    search_settings: ClassVar[frozenset[str]] = frozenset()
    """Parameters that a search reads and the structure does not depend on."""
    search_ladder: ClassVar[Ladder | None] = None
    """The one of them that trades time for recall, and values from the fastest on."""
    build_ladder: ClassVar[Ladder | None] = None
    """A parameter of the structure that trades memory for recall; `retrieve frontier` compares its values."""
    parameters_type: ClassVar[type[Parameters]] = Parameters
    min_vectors: ClassVar[int] = 1
    """Vectors that a build needs."""
    parameters: Parameters

    def __init_subclass__(cls) -> None:
        if "kind" not in vars(cls):
            cls.kind = f"{cls.__module__}:{cls.__qualname__}"

    def __init__(self, vectors: Floats, parameters: Any, seed: int, threads: int | None) -> None:
        """Used by `build` and `load`, which check what comes here."""
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
        """An index of `vectors` (M, d), M >= 1. `names` (M,) are the rows' names in messages.

        `parameters` None takes the defaults; `.parameters` of the result has every None filled in.
        `threads` None leaves the library's own setting. The same input and seed give the same index.
        """
        table = check_unit(vectors, names=names)
        if not len(table):
            raise VectorError("an index needs at least one vector; got none")
        return cls.build_checked(table, cls.check_parameters(parameters), seed=seed, threads=threads)

    @classmethod
    def check_parameters(cls, parameters: Parameters | None) -> Parameters:
        """The parameters, or the defaults for None; of another kind they raise `ParameterError`."""
        check_parameters = cls.parameters_type() if parameters is None else parameters
        if not isinstance(check_parameters, cls.parameters_type):
            raise ParameterError(
                f"{cls.kind} takes {cls.parameters_type.__name__}; got {type(check_parameters).__name__}"
            )
        return check_parameters

    @classmethod
    def build_checked(
        cls, vectors: Floats, parameters: Parameters, *, seed: int = 0, threads: int | None = None
    ) -> Self:
        """`build` over vectors (M, d), M >= 1, that were checked before."""
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
        """The index that `save` wrote to `path`, over the same `vectors` (M, d), which may be memory-mapped.

        A file that is unreadable or does not fit raises `CorruptIndex`. The vectors are trusted.
        """
        index = cls(vectors, parameters, seed, check_threads(threads))
        if cls.structure_file:
            if path is None:
                raise ParameterError(f"{cls.kind} is loaded from a file; got no path")
            index._read(Path(path))
        else:
            index._build()
        return index

    @classmethod
    def parameters_from(cls, settings: Mapping[str, Any]) -> Parameters:
        """This kind's parameters from names and values; an unknown name raises `ParameterError`."""
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
        """The vectors (M, d); not to be written to."""
        return self._vectors

    def settings(self) -> dict[str, Any]:
        """The parameters as a JSON object."""
        return asdict(self.parameters)

    def search(self, queries: Floats, k: int, live: Mask | None = None) -> tuple[Floats, Slots]:
        """The best k slots of each unit query (Q, d): scores (Q, k') float32 and slots (Q, k') int64.

        `live` (M,) leaves out the slots where it is false; k' = min(k, number of live slots).
        """
        table, wanted = self._check_query(queries, k, live)
        if wanted == 0 or not len(table):
            shape = (len(table), wanted)
            return np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.int64)
        scores, slots = self._search(table, wanted, live)
        return scores, check_slots(slots, self.count)

    def candidates(self, queries: Floats, k: int, live: Mask | None = None) -> list[Slots]:
        """The slots that `search` finds, of each query and in no order, for whoever scores them otherwise: an exact
        kind names just these, an approximate one at least k' of its best. Takes less time, as few are scored.
        """
        table, wanted = self._check_query(queries, k, live)
        if wanted == 0:
            return [np.empty(0, dtype=np.int64) for _ in table]
        named = [self._candidate_slots(query[None], wanted, live) for query in table]
        for slots in named:
            check_slots(slots[None], self.count)
        return named

    def _check_query(self, queries: Floats, k: int, live: Mask | None) -> tuple[Floats, int]:
        """The queries, and how many slots each can have."""
        k = check_k(k)
        table = check_unit(queries, dim=self.dim, what="query")
        if live is not None and (live.shape != (self.count,) or live.dtype != np.bool_):
            raise ParameterError(f"live must be bool of shape ({self.count},); got {live.dtype} {live.shape}")
        return table, min(k, self.count if live is None else int(np.count_nonzero(live)))

    def add(self, vectors: Floats, *, names: Sequence[str] | None = None) -> None:
        """Append `vectors` (F, d) as slots M..M+F-1; F = 0 changes nothing."""
        fresh = check_unit(vectors, dim=self.dim, names=names)
        if len(fresh):
            self.grow(np.concatenate([self._vectors, fresh]))

    def grow(self, vectors: Floats) -> None:
        """Search `vectors` (M', d), M' >= M, of which the first M are those of this index and all were checked."""
        self._vectors = vectors
        self._extend_structure()

    def save(self, path: str | Path) -> bool:
        """Write the structure to `path`; False, and nothing written, for a kind that has none."""
        if self.structure_file:
            self._write(Path(path))
        return self.structure_file

    def copy(self) -> Self:
        """An index whose `add` and `grow` leave this one as it is. The vectors are shared."""
        return copy.copy(self)

    def with_settings(self, **settings: Any) -> Self:
        """The same structure searched with other settings, for example `with_settings(ef_search=128)`."""
        fixed = sorted(set(settings) - self.search_settings)
        if fixed:
            can = ", ".join(sorted(self.search_settings)) or "nothing"
            raise ParameterError(f"{self.kind} can change {can} without a new build; got {', '.join(fixed)}")
        other = copy.copy(self)
        other.parameters = replace(self.parameters, **settings)
        return other

    def search_variants(self) -> Iterator[Self]:
        """The same structure with each value of its `search_ladder`; one without a ladder as it is."""
        if self.search_ladder is None:
            yield self
            return
        setting, values = self.search_ladder
        for value in values:
            yield self.with_settings(**{setting: value})

    @classmethod
    def resolve_parameters(cls, check_parameters: Any, count: int, dim: int) -> Any:
        """The parameters with every None filled in for `count` vectors of `dim` components, or `ParameterError` where
        this kind cannot be built over so many.
        """
        if count < cls.min_vectors:
            raise ParameterError(f"{cls.kind} needs {cls.min_vectors} or more vectors to train its codes; got {count}")
        return check_parameters

    @abstractmethod
    def _search(self, queries: Floats, k: int, live: Mask | None) -> tuple[Floats, Slots]:
        """The result of `search`: queries are checked, and 1 <= k <= live slots."""

    def _candidate_slots(self, query: Floats, k: int, live: Mask | None) -> Slots:
        """The result of `candidates` for one query (1, d), checked as those of `_search` are."""
        slots: Slots = self._search(query, k, live)[1][0]
        return slots

    def _build(self) -> None:  # noqa: B027 - nothing to do without a structure
        """Make the structure over `self._vectors`."""

    def _extend_structure(self) -> None:  # noqa: B027 - nothing to do without a structure
        """Take in that `self._vectors` has more vectors than before."""

    def _read(self, path: Path) -> None:
        """Read the structure and check that it holds `self._vectors`."""
        raise NotImplementedError

    def _write(self, path: Path) -> None:
        """Write the structure."""
        raise NotImplementedError


def check_threads(threads: int | None) -> int | None:
    """`threads`, None or a whole number from 1 to `MAX_THREADS`, or `ParameterError`."""
    if threads is not None and not is_whole(threads, 1, MAX_THREADS):
        raise ParameterError(f"threads must be a whole number from 1 to {MAX_THREADS}, or left out; got {threads!r}")
    return threads


def check_seed(seed: int) -> int:
    """`seed`, a whole number from 0 to `MAX_COUNT`, or `ParameterError`."""
    if not is_whole(seed, 0, MAX_COUNT):
        raise ParameterError(f"a seed must be a whole number from 0 to {MAX_COUNT}; got {seed!r}")
    return seed


def is_whole(value: object, minimum: int, maximum: float) -> bool:
    """Whether it is a whole number from `minimum` to `maximum`."""
    return isinstance(value, int) and not isinstance(value, bool) and minimum <= value <= maximum
