"""Rows on the disk: text that is parsed when somebody looks, and a table of what searching needs of each.

What is compared over all rows is an array, not a table of SQLite: docs/formats.md says what was measured.
"""

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

KEYS = ("id", "digest", "object_id")
"""Fields of a row that are compared over all rows, and so stand in the table as keys (see `key_of`)."""

RECORD = np.dtype([("slot", "<i8"), ("stop", "<i8"), *((name, "S16") for name in KEYS)])
"""What the table holds of a row: its slot, where its line ends in the text (and the next one begins), and its keys."""

MAX_LINEAR_KEYS = 8
"""Keys that are looked for one by one: sorting all, to find many of them, takes as long."""

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


class KeyIndex:
    """Finds keys (N,), N >= 1."""

    def __init__(self, keys: NDArray[np.bytes_]) -> None:
        self.keys = keys

    def find(self, wanted: NDArray[np.bytes_]) -> Slots:
        """Return the place of a key that equals each wanted one (n,); -1 where none does.

        A list that a few keys were put into or taken from has most of them where they stood, counted from one of its
        ends; only the rest is searched for.
        """
        shared = min(len(self.keys), len(wanted))
        head = _leading(self.keys[:shared] == wanted[:shared])
        tail = _leading(self.keys[::-1][: shared - head] == wanted[::-1][: shared - head])
        last = len(self.keys) - tail
        between = wanted[head : len(wanted) - tail]
        return np.concatenate([np.arange(head), self._search(between), np.arange(last, len(self.keys))])

    def _search(self, wanted: NDArray[np.bytes_]) -> Slots:
        if len(wanted) <= MAX_LINEAR_KEYS:
            return np.array([self._first(key) for key in wanted], np.int64)
        order, ranked = self._sorted
        beginnings = _beginnings(wanted)
        place = np.minimum(np.searchsorted(ranked, beginnings), len(ranked) - 1)
        found: Slots = np.where(self.keys[order[place]] == wanted, order[place], -1)
        for number in np.flatnonzero((found < 0) & (ranked[place] == beginnings)):  # perhaps another one begins so
            found[number] = self._first(wanted[number])
        return found

    def _first(self, key: np.bytes_) -> int:
        return next(iter(np.flatnonzero(self.keys == key).tolist()), -1)

    @cached_property
    def _sorted(self) -> tuple[Slots, NDArray[np.uint64]]:
        """The order (N,) in which the beginnings of the keys grow, and these (N,): numbers are sorted and searched in
        a tenth of the time of bytes.
        """
        beginnings = _beginnings(self.keys)
        order = np.argsort(beginnings, kind="stable")
        return order, beginnings[order]


def are_distinct(keys: NDArray[np.bytes_]) -> bool:
    """Whether no two of the keys (N,) are equal."""
    ranked = np.sort(_beginnings(keys))
    return bool((ranked[1:] != ranked[:-1]).all()) or len(np.unique(keys)) == len(keys)


def _beginnings(keys: NDArray[np.bytes_]) -> NDArray[np.uint64]:
    """The first 8 bytes of each key (N,) as a number."""
    words: NDArray[np.uint64] = np.ascontiguousarray(keys).view(np.uint64)[::2]
    return words


def _leading(same: NDArray[np.bool_]) -> int:
    """How many are true before the first that is not."""
    return len(same) if same.all() else int(np.argmin(same))


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
        numbers = range(len(self))[index]
        return self._parse_row(numbers) if isinstance(numbers, int) else [self._parse_row(number) for number in numbers]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sequence):
            return NotImplemented
        return len(self) == len(other) and all(mine == its for mine, its in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def start(self, number: int) -> int:
        """Where a row's line begins in the text."""
        return int(self.table["stop"][number - 1]) if number else 0

    def line(self, number: int) -> bytes:
        """The JSON of a row as it was written, without the end of its line."""
        return self.text[self.start(number) : int(self.table["stop"][number]) - 1].tobytes()

    def lines_end_with(self, text: bytes) -> NDArray[np.bool_]:
        """Whether each row's line (N,), without the end of the line, ends with this text; nothing is parsed."""
        stops = self.table["stop"] - 1
        same: NDArray[np.bool_] = np.diff(stops, prepend=-1) > len(text)
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
        return self.by_id.find(keys_of(ids))

    @cached_property
    def by_id(self) -> KeyIndex:
        """Finds rows by the keys of their ids."""
        return KeyIndex(self.keys("id"))

    @cached_property
    def by_digest(self) -> KeyIndex:
        """Finds rows by the keys of their contents' digests."""
        return KeyIndex(self.keys("digest"))

    def _parse_row(self, number: int) -> dict[str, Any]:
        line = self.line(number)
        if len(line) >= MAX_LINE_BYTES:
            raise CorruptIndex(f"row {number} of the index must have {MAX_LINE_BYTES} bytes or less; {AGAIN}")
        try:
            row = parse_json(line)
        except ValueError as error:
            raise CorruptIndex(f"row {number} of the index cannot be read ({error}); {AGAIN}") from error
        if not isinstance(row, dict) or not isinstance(row.get("id"), str):
            raise CorruptIndex(f"row {number} of the index must be a plain object with an id; {AGAIN}")
        for name in KEYS:
            if self.table[name][number] != key_of(row.get(name)).rstrip(b"\0"):  # numpy drops zeros at the end of bytes
                raise CorruptIndex(f"row {number} of the index: its table has another {name} than its text; {AGAIN}")
        return row


def json_of(document: Any, what: str, row: str | None = None, checked: bytes = b"") -> bytes:
    """`document` as JSON that reads back the same, or `RowError` naming `what`. `checked` is JSON that is known to."""
    try:
        text = files.encoded(document)
        if text == checked:
            return text
        if files.is_deep(document):
            raise RowError(f"{what} must not be nested deeper than {files.MAX_DEPTH} levels", row)
        same = json.loads(text) == document
    except (ValueError, TypeError) as error:
        raise RowError(f"{what} must be JSON of finite numbers; {error}", row) from error
    if not same:
        raise RowError(f"{what} must read back from JSON as it is: text keys, lists rather than tuples", row)
    return text
