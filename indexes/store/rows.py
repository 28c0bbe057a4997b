"""Rows on the disk: text that is parsed when somebody looks, and a table of what searching needs of each."""

import json
from collections.abc import Iterable, Sequence
from functools import cached_property
from hashlib import blake2b
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval import files
from _touch_retrieval.files import parse_json
from indexes.errors import AGAIN, CorruptIndex, RowError
from indexes.kinds.scores import Slots

FEW = 32
"""Keys that are looked for one by one: sorting all, to find many of them, takes as long."""

KEYS = ("id", "digest", "object_id")
"""Fields of a row that are compared over all rows, and so stand in the table as keys (see `key_of`)."""

RECORD = np.dtype([("slot", "<i8"), ("start", "<i8"), ("stop", "<i8"), *((name, "S16") for name in KEYS)])
"""What the table holds of a row: its slot, the bytes of its line in the text, and its keys."""

MAX_LINE_BYTES = 2**20
"""Of the JSON of a row."""

_BLANK = blake2b(digest_size=16)


def key_of(value: object) -> bytes:
    """128 bits of BLAKE2 of a text, no bytes for what is no text.

    Equal for equal texts; that any two of a million different ones agree has a chance of 2e-27.
    """
    if not isinstance(value, str):
        return b""
    hashed = _BLANK.copy()  # made anew it takes twice as long
    hashed.update(value.encode("utf-8", "surrogatepass"))
    return hashed.digest()


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
        return _found(keys, self._keys_by_id)

    def holding(self, digests: Iterable[str]) -> Slots:
        """For each digest the number of a row of that content (n,), -1 where there is none."""
        return _found(keys_of(digests), self._keys_by_digest)

    @cached_property
    def _keys_by_id(self) -> "_Places":
        return _Places(self.keys("id"))

    @cached_property
    def _keys_by_digest(self) -> "_Places":
        return _Places(self.keys("digest"))

    def _parsed(self, number: int) -> dict[str, Any]:
        record = self.table[number]
        if record["stop"] - record["start"] > MAX_LINE_BYTES:
            raise CorruptIndex(f"row {number} of the index must have {MAX_LINE_BYTES} bytes or less; {AGAIN}")
        try:
            row = parse_json(self.line(number))
        except ValueError as error:
            raise CorruptIndex(f"row {number} of the index cannot be read ({error}); {AGAIN}") from error
        if not isinstance(row, dict) or not isinstance(row.get("id"), str):
            raise CorruptIndex(f"row {number} of the index must be a plain object with an id; {AGAIN}")
        for name in KEYS:
            if record[name] != key_of(row.get(name)).rstrip(b"\0"):  # as numpy gives bytes of a fixed length
                raise CorruptIndex(f"row {number} of the index: its table has another {name} than its text; {AGAIN}")
        return row


class _Places:
    """Where keys (N,) stand."""

    def __init__(self, keys: NDArray[np.bytes_]) -> None:
        self.keys, self.words = keys, _words(keys)

    @cached_property
    def _sorted(self) -> tuple[Slots, NDArray[np.uint64]]:
        """The order (N,) in which the first eight bytes of keys, taken for numbers, grow, and these (N,): numbers are
        sorted and searched in a tenth of the time of bytes."""
        order = np.argsort(self.words[:, 0], kind="stable")
        return order, self.words[order, 0]

    def of(self, wanted: NDArray[np.bytes_]) -> Slots:
        """The place of the first key that equals each wanted one (n,); -1 where none does."""
        if len(wanted) <= FEW:
            return np.array([self._first(key) for key in wanted], np.int64)
        order, ranked = self._sorted
        beginnings = _words(wanted)[:, 0]
        place = np.minimum(np.searchsorted(ranked, beginnings), len(ranked) - 1)
        numbers = np.where(self.keys[order[place]] == wanted, order[place], -1)
        alike = (numbers < 0) & (ranked[place] == beginnings)  # others begin so too, or this one alone
        for number in np.flatnonzero(alike).tolist():
            numbers[number] = self._first(wanted[number])
        return numbers

    def _first(self, key: np.bytes_) -> int:
        begin_so = np.flatnonzero(self.words[:, 0] == _words(np.array([key], "S16"))[0, 0])
        same = begin_so[self.keys[begin_so] == key]
        return int(same[0]) if len(same) else -1


def _words(keys: NDArray[np.bytes_]) -> NDArray[np.uint64]:
    """The 16 bytes of each key (N,) as two numbers (N, 2)."""
    words: NDArray[np.uint64] = np.ascontiguousarray(keys).view(np.uint64).reshape(-1, 2)
    return words


def are_distinct(keys: NDArray[np.bytes_]) -> bool:
    """Whether no two of the keys (N,) are equal."""
    beginnings = np.sort(_words(keys)[:, 0])
    return bool((beginnings[1:] != beginnings[:-1]).all()) or len(np.unique(keys)) == len(keys)


def first_equal(keys: NDArray[np.bytes_], wanted: NDArray[np.bytes_]) -> Slots:
    """For each wanted key (n,) the place of the first of `keys` (N,), N >= 1, that equals it; -1 where none does."""
    return _found(wanted, _Places(keys))


def _found(wanted: NDArray[np.bytes_], known: _Places) -> Slots:
    """As `_Places.of`. A list that a few keys were put into or taken from has most of them where they stood, counted
    from one of its ends; the rest alone is searched for."""
    before, after = known.words, _words(wanted)
    shared = min(len(before), len(after))
    head = _agreeing((before[:shared] == after[:shared]).all(axis=1))
    tail = _agreeing((before[::-1][: shared - head] == after[::-1][: shared - head]).all(axis=1))
    last = len(after) - tail
    numbers = np.empty(len(after), np.int64)
    numbers[:head] = np.arange(head)
    numbers[last:] = np.arange(len(before) - tail, len(before))
    if head < last:
        numbers[head:last] = known.of(wanted[head:last])
    return numbers


def _agreeing(same: NDArray[np.bool_]) -> int:
    """How many are true before the first that is not."""
    return len(same) if same.all() else int(np.argmin(same))


def json_of(document: Any, what: str, row: str | None = None, checked: bytes = b"") -> bytes:
    """`document` as JSON that reads back the same, or `RowError` naming `what`. `checked` is JSON that is known to."""
    try:
        text = files.encoded(document)
        if text == checked:
            return text
        if files.is_deep(document):
            raise RowError(f"{what} must not be nested deeper than {files.DEEPEST} levels", row)
        same = json.loads(text) == document
    except (ValueError, TypeError, RecursionError) as error:
        raise RowError(f"{what} must be JSON of finite numbers; {error}", row) from error
    if not same:
        raise RowError(f"{what} must read back from JSON as it is: text keys, lists rather than tuples", row)
    return text
