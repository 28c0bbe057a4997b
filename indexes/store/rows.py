"""Rows on the disk: text that is parsed when somebody looks, and a table of what searching needs of each.

A segment of records is three kinds of files: the rows as lines of JSON, the table (`RECORD`) and the per-row arrays.
A record never changes; a generation is a list of segments and the order in which it shows their records.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from indexes.errors import AGAIN, CorruptIndex
from indexes.kinds.scores import Slots
from indexes.kinds.stack import stacked
from indexes.store.regular import parse_json

KEYS = ("id", "digest", "object_id")
"""Fields of a row that are compared over all rows, and so stand in the table as keys (see `key_of`)."""

RECORD = np.dtype([("slot", "<i8"), ("start", "<i8"), ("stop", "<i8"), *((name, "S16") for name in KEYS)])
"""A record's slot, the bytes of its line in its segment's text, and its keys."""


def key_of(value: object) -> bytes:
    """128 bits of BLAKE2 of a text, no bytes for what is no text.

    Equal for equal texts; that any two of a million different ones agree has a chance of 2e-27.
    """
    if not isinstance(value, str):
        return b""
    return blake2b(value.encode("utf-8", "surrogatepass"), digest_size=16).digest()


def keys_of(values: Iterable[object]) -> NDArray[np.bytes_]:
    """`key_of` each value (N,)."""
    return np.array([key_of(value) for value in values], "S16")


@dataclass(frozen=True)
class Segment:
    """Records of one writing: the bytes of their lines, their table (n,), and name -> per-row array (n, ...)."""

    text: NDArray[np.uint8]
    table: NDArray[Any]
    arrays: Mapping[str, NDArray[Any]]


class Records:
    """The records of several segments, one after another: places 0..R-1."""

    def __init__(self, segments: Sequence[Segment]) -> None:
        self.segments = list(segments)
        self._starts = np.cumsum([0, *(len(segment.table) for segment in segments)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def column(self, name: str, places: Slots | None = None) -> NDArray[Any]:
        """A column (n,) of the table at the places (all where None), in memory."""
        whole = np.concatenate([segment.table[name] for segment in self.segments])
        return whole if places is None else whole[places]

    def array(self, name: str, order: Slots | None = None) -> Any:
        """The per-row array of that name in the order of the places given."""
        return stacked([segment.arrays[name] for segment in self.segments], order)

    def line(self, place: int) -> bytes:
        """The JSON of the record at a place, as it was written, without the end of its line."""
        number = int(np.searchsorted(self._starts, place, side="right")) - 1
        segment = self.segments[number]
        record = segment.table[place - self._starts[number]]
        return segment.text[int(record["start"]) : int(record["stop"]) - 1].tobytes()


class Rows(Sequence[dict[str, Any]]):
    """The rows of a generation, each parsed when it is asked for."""

    def __init__(self, records: Records, places: Slots) -> None:
        self.records, self.places = records, places

    def __len__(self) -> int:
        return len(self.places)

    @overload
    def __getitem__(self, index: int) -> dict[str, Any]: ...

    @overload
    def __getitem__(self, index: slice) -> list[dict[str, Any]]: ...

    def __getitem__(self, index: int | slice) -> dict[str, Any] | list[dict[str, Any]]:
        if isinstance(index, slice):
            return [self._parsed(int(place)) for place in self.places[index]]
        return self._parsed(int(self.places[index]))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sequence):
            return NotImplemented
        return len(self) == len(other) and all(mine == its for mine, its in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def keys(self, name: str) -> NDArray[np.bytes_]:
        """`key_of` the field `name`, one of `KEYS`, of every row (N,); nothing is parsed."""
        return self.records.column(name, self.places)

    def ids(self, numbers: Slots) -> list[str]:
        """The ids of the rows with these numbers."""
        return [self[int(number)]["id"] for number in numbers]

    def find(self, ids: Iterable[str]) -> Slots:
        """For each id its row's number (n,), -1 where there is none."""
        return self._found(ids, self._by_id)

    def holding(self, digests: Iterable[str]) -> Slots:
        """For each digest the number of a row of that content (n,), -1 where there is none."""
        return self._found(digests, self._by_digest)

    def _found(self, values: Iterable[str], sorted_keys: tuple[Slots, NDArray[np.bytes_]]) -> Slots:
        wanted, (by_key, ranked) = keys_of(values), sorted_keys
        place = np.minimum(np.searchsorted(ranked, wanted), len(ranked) - 1)
        return np.where(ranked[place] == wanted, by_key[place], -1)

    @cached_property
    def _by_id(self) -> tuple[Slots, NDArray[np.bytes_]]:
        return self._sorted("id")

    @cached_property
    def _by_digest(self) -> tuple[Slots, NDArray[np.bytes_]]:
        return self._sorted("digest")

    def _sorted(self, name: str) -> tuple[Slots, NDArray[np.bytes_]]:
        keys = self.keys(name)
        order = np.argsort(keys, kind="stable")
        return order, keys[order]

    def _parsed(self, place: int) -> dict[str, Any]:
        try:
            row = parse_json(self.records.line(place))
        except ValueError as error:
            raise CorruptIndex(f"the row at place {place} of the index cannot be read ({error}); {AGAIN}") from error
        if not isinstance(row, dict) or not isinstance(row.get("id"), str):
            raise CorruptIndex(f"the row at place {place} of the index must be a plain object with an id; {AGAIN}")
        return row
