"""Rows on the disk: JSON lines that are parsed on access, and a table of the fields that searches need.

The compared fields of all rows are an array, not a SQLite table; docs/formats.md has the measurements.
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
"""Fields that are compared over all rows; the table contains their keys (`key_of`)."""

RECORD = np.dtype([("slot", "<i8"), ("stop", "<i8"), *((name, "S16") for name in KEYS)])
"""Table entry of a row: its slot, the end of its line in the text (where the next line begins), and its keys."""

MAX_LINEAR_KEYS = 8
"""Largest number of keys that are searched for one by one; for more, sorting all keys is faster."""

MAX_LINE_BYTES = 2**20
"""Limit of the JSON of a row."""

_BLANK = blake2b(digest_size=16)


def key_of(value: object) -> bytes:
    """Return 128 bits of BLAKE2 of a text; no bytes for any other value.

    The probability that any two of a million different texts have the same key is 2e-27.
    """
    if not isinstance(value, str):
        return b""
    hashed = _BLANK.copy()  # a new hash object would take twice as long
    hashed.update(value.encode("utf-8", "surrogatepass"))
    return hashed.digest()


def keys_of(values: Iterable[object]) -> NDArray[np.bytes_]:
    """Return `key_of` each value (N,)."""
    return np.array([key_of(value) for value in values], "S16")


class KeyIndex:
    """Search over keys (N,), N >= 1."""

    def __init__(self, keys: NDArray[np.bytes_]) -> None:
        self.keys = keys

    def find(self, keys: NDArray[np.bytes_]) -> Slots:
        """Return the position of each key.

        If a few keys were inserted or removed, most keys still have the same position, counted from the start or the
        end. Only the others are searched for.

        Args:
            keys: Keys (n,) to find.

        Returns:
            Positions (n,); -1 for a key that is missing.
        """
        shared = min(len(self.keys), len(keys))
        head = _leading(self.keys[:shared] == keys[:shared])
        tail = _leading(self.keys[::-1][: shared - head] == keys[::-1][: shared - head])
        last = len(self.keys) - tail
        between = keys[head : len(keys) - tail]
        return np.concatenate([np.arange(head), self._search(between), np.arange(last, len(self.keys))])

    def _search(self, keys: NDArray[np.bytes_]) -> Slots:
        if len(keys) <= MAX_LINEAR_KEYS:
            return np.array([self._first(key) for key in keys], np.int64)
        order, ranked = self._sorted
        prefixes = _prefixes(keys)
        place = np.minimum(np.searchsorted(ranked, prefixes), len(ranked) - 1)
        found: Slots = np.where(self.keys[order[place]] == keys, order[place], -1)
        for number in np.flatnonzero((found < 0) & (ranked[place] == prefixes)):  # another key may have this prefix
            found[number] = self._first(keys[number])
        return found

    def _first(self, key: np.bytes_) -> int:
        return next(iter(np.flatnonzero(self.keys == key).tolist()), -1)

    @cached_property
    def _sorted(self) -> tuple[Slots, NDArray[np.uint64]]:
        """The sort order (N,) of the key prefixes, and the sorted prefixes (N,).

        Sorting and searching numbers takes a tenth of the time of bytes.
        """
        prefixes = _prefixes(self.keys)
        order = np.argsort(prefixes, kind="stable")
        return order, prefixes[order]


def are_distinct(keys: NDArray[np.bytes_]) -> bool:
    """Whether no two of the keys (N,) are equal."""
    ranked = np.sort(_prefixes(keys))
    return bool((ranked[1:] != ranked[:-1]).all()) or len(np.unique(keys)) == len(keys)


def _prefixes(keys: NDArray[np.bytes_]) -> NDArray[np.uint64]:
    """Return the first 8 bytes of each key (N,) as a number."""
    words: NDArray[np.uint64] = np.ascontiguousarray(keys).view(np.uint64)[::2]
    return words


def _leading(same: NDArray[np.bool_]) -> int:
    """Return the number of true values before the first false one."""
    return len(same) if same.all() else int(np.argmin(same))


class Rows(Sequence[dict[str, Any]]):
    """The rows of a generation, parsed on access.

    Attributes:
        text: Bytes of all lines of JSON.
        table: Array (N,) of `RECORD`, in the order of the rows.
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
        """Return the position in the text where a row's line begins."""
        return int(self.table["stop"][number - 1]) if number else 0

    def line(self, number: int) -> bytes:
        """Return the JSON of a row as it was written, without the line break."""
        return self.text[self.start(number) : int(self.table["stop"][number]) - 1].tobytes()

    def lines_end_with(self, text: bytes) -> NDArray[np.bool_]:
        """Return whether each row's line (N,), without the line break, ends with this text; nothing is parsed."""
        stops = self.table["stop"] - 1
        same: NDArray[np.bool_] = np.diff(stops, prepend=-1) > len(text)
        for back, byte in enumerate(reversed(text), start=1):
            same &= self.text[np.maximum(stops - back, 0)] == byte
        return same

    def keys(self, name: str) -> NDArray[np.bytes_]:
        """Return `key_of` the field `name`, one of `KEYS`, of every row (N,); nothing is parsed."""
        return np.ascontiguousarray(self.table[name])

    def ids(self, numbers: Slots) -> list[str]:
        """Return the ids of the rows with these numbers."""
        return [self[int(number)]["id"] for number in numbers]

    def find(self, ids: Iterable[str]) -> Slots:
        """Return the row number of each id (n,); -1 for a missing id."""
        return self.by_id.find(keys_of(ids))

    @cached_property
    def by_id(self) -> KeyIndex:
        """Search by the keys of the ids."""
        return KeyIndex(self.keys("id"))

    @cached_property
    def by_digest(self) -> KeyIndex:
        """Search by the keys of the content digests."""
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
            if self.table[name][number] != key_of(row.get(name)).rstrip(b"\0"):  # numpy strips trailing zero bytes
                raise CorruptIndex(f"row {number} of the index: table and text have different {name}; {AGAIN}")
        return row


def json_of(document: Any, what: str, row: str | None = None, checked: bytes = b"") -> bytes:
    """Return a document as JSON after checking that it reads back unchanged.

    Args:
        document: The document.
        what: Its name in messages.
        row: Id of its row, for the error.
        checked: JSON that is known to read back unchanged, which skips the check if it is equal.

    Raises:
        RowError: The document is not JSON, is nested too deep, or reads back changed.
    """
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
        raise RowError(f"{what} must read back from JSON unchanged: use text keys, and lists instead of tuples", row)
    return text
