"""Rows on the disk: text that is parsed when somebody looks, and a table of what searching needs of each."""

from collections.abc import Iterable, Sequence
from functools import cached_property
from hashlib import blake2b
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from indexes.errors import AGAIN, CorruptIndex
from indexes.kinds.scores import Slots
from indexes.store.regular import parse_json

KEYS = ("id", "digest", "object_id")
"""Fields of a row that are compared over all rows, and so stand in the table as keys (see `key_of`)."""

RECORD = np.dtype([("slot", "<i8"), ("start", "<i8"), ("stop", "<i8"), *((name, "S16") for name in KEYS)])
"""What the table holds of a row: its slot, the bytes of its line in the text, and its keys."""


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


class Rows(Sequence[dict[str, Any]]):
    """The rows of a generation, each parsed when it is asked for.

    text: the bytes of all lines of JSON; table (N,) of `RECORD`, in the order of the rows.
    """

    def __init__(self, text: NDArray[np.uint8], table: NDArray[Any]) -> None:
        self.text, self.table = text, table

    def __len__(self) -> int:
        return len(self.table)

    @overload
    def __getitem__(self, index: int) -> dict[str, Any]: ...

    @overload
    def __getitem__(self, index: slice) -> list[dict[str, Any]]: ...

    def __getitem__(self, index: int | slice) -> dict[str, Any] | list[dict[str, Any]]:
        if isinstance(index, slice):
            return [self._parsed(number) for number in range(*index.indices(len(self)))]
        return self._parsed(range(len(self))[index])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sequence):
            return NotImplemented
        return len(self) == len(other) and all(mine == its for mine, its in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def line(self, number: int) -> bytes:
        """The JSON of a row as it was written, without the end of its line."""
        record = self.table[number]
        return self.text[int(record["start"]) : int(record["stop"]) - 1].tobytes()

    def ending(self, text: bytes) -> NDArray[np.bool_]:
        """Whether each row's line (N,), without the end of the line, ends with this text; nothing is parsed."""
        stops = self.table["stop"] - 1
        same: NDArray[np.bool_] = stops - self.table["start"] >= len(text)
        for back, byte in enumerate(reversed(text), start=1):
            same &= self.text[np.maximum(stops - back, 0)] == byte
        return same

    def keys(self, name: str) -> NDArray[np.bytes_]:
        """`key_of` the field `name`, one of `KEYS`, of every row (N,); nothing is parsed."""
        return np.ascontiguousarray(self.table[name])

    def ids(self, numbers: Slots) -> list[str]:
        """The ids of the rows with these numbers."""
        return [self[int(number)]["id"] for number in numbers]

    def find(self, ids: Iterable[str]) -> Slots:
        """For each id its row's number (n,), -1 where there is none."""
        return self.find_keys(keys_of(ids))

    def find_keys(self, keys: NDArray[np.bytes_]) -> Slots:
        """As `find`, for the keys (n,) of ids."""
        return _found(keys, self._by_id)

    def holding(self, digests: Iterable[str]) -> Slots:
        """For each digest the number of a row of that content (n,), -1 where there is none."""
        return _found(keys_of(digests), self._by_digest)

    @cached_property
    def _by_id(self) -> "_Sorted":
        return _sorted(self.keys("id"))

    @cached_property
    def _by_digest(self) -> "_Sorted":
        return _sorted(self.keys("digest"))

    def _parsed(self, number: int) -> dict[str, Any]:
        try:
            row = parse_json(self.line(number))
        except ValueError as error:
            raise CorruptIndex(f"row {number} of the index cannot be read ({error}); {AGAIN}") from error
        if not isinstance(row, dict) or not isinstance(row.get("id"), str):
            raise CorruptIndex(f"row {number} of the index must be a plain object with an id; {AGAIN}")
        return row


class _Sorted(NamedTuple):
    """Keys (N,), and the order (N,) in which their first eight bytes `ranked` (N,), taken for numbers, grow: numbers
    are sorted and searched in a tenth of the time of bytes."""

    keys: NDArray[np.bytes_]
    order: Slots
    ranked: NDArray[np.uint64]


def _sorted(keys: NDArray[np.bytes_]) -> _Sorted:
    beginnings = _beginnings(keys)
    order = np.argsort(beginnings, kind="stable")
    return _Sorted(keys, order, beginnings[order])


def _beginnings(keys: NDArray[np.bytes_]) -> NDArray[np.uint64]:
    beginnings: NDArray[np.uint64] = np.ascontiguousarray(keys).view(np.uint64)[::2]
    return beginnings


def first_equal(keys: NDArray[np.bytes_], wanted: NDArray[np.bytes_]) -> Slots:
    """For each wanted key (n,) the place of the first of `keys` (N,), N >= 1, that equals it; -1 where none does."""
    return _found(wanted, _sorted(keys))


def _found(wanted: NDArray[np.bytes_], known: _Sorted) -> Slots:
    beginnings = _beginnings(wanted)
    place = np.minimum(np.searchsorted(known.ranked, beginnings), len(known.ranked) - 1)
    numbers = np.where(known.keys[known.order[place]] == wanted, known.order[place], -1)
    alike = (numbers < 0) & (known.ranked[place] == beginnings)  # others begin so too, or this one alone
    for number in np.flatnonzero(alike).tolist():
        same = np.flatnonzero(known.keys == wanted[number])
        numbers[number] = same[0] if len(same) else -1
    return numbers
