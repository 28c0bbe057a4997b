"""Rows on the disk: text that is parsed when somebody looks, and a table of what searching needs of each."""

from collections.abc import Iterable, Sequence
from functools import cached_property
from hashlib import blake2b
from typing import Any, overload

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

    def keys(self, name: str) -> NDArray[np.bytes_]:
        """`key_of` the field `name`, one of `KEYS`, of every row (N,); nothing is parsed."""
        return np.ascontiguousarray(self.table[name])

    def ids(self, numbers: Slots) -> list[str]:
        """The ids of the rows with these numbers."""
        return [self[int(number)]["id"] for number in numbers]

    def find(self, ids: Iterable[str]) -> Slots:
        """For each id its row's number (n,), -1 where there is none."""
        return _found(ids, self._by_id)

    def holding(self, digests: Iterable[str]) -> Slots:
        """For each digest the number of a row of that content (n,), -1 where there is none."""
        return _found(digests, self._by_digest)

    @cached_property
    def _by_id(self) -> tuple[Slots, NDArray[np.bytes_]]:
        return _sorted(self.keys("id"))

    @cached_property
    def _by_digest(self) -> tuple[Slots, NDArray[np.bytes_]]:
        return _sorted(self.keys("digest"))

    def _parsed(self, number: int) -> dict[str, Any]:
        try:
            row = parse_json(self.line(number))
        except ValueError as error:
            raise CorruptIndex(f"row {number} of the index cannot be read ({error}); {AGAIN}") from error
        if not isinstance(row, dict) or not isinstance(row.get("id"), str):
            raise CorruptIndex(f"row {number} of the index must be a plain object with an id; {AGAIN}")
        return row


def _sorted(keys: NDArray[np.bytes_]) -> tuple[Slots, NDArray[np.bytes_]]:
    order = np.argsort(keys, kind="stable")
    return order, keys[order]


def _found(values: Iterable[str], sorted_keys: tuple[Slots, NDArray[np.bytes_]]) -> Slots:
    wanted, (order, ranked) = keys_of(values), sorted_keys
    place = np.minimum(np.searchsorted(ranked, wanted), len(ranked) - 1)
    return np.where(ranked[place] == wanted, order[place], -1)
