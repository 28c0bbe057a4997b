"""Rows of an index: `rows.jsonl`, lines that are parsed on access, and `rows.npy`, numbers that every search needs.

Rows are sorted by path, and objects are numbered by name, so a photo or an object is found by bisection.
"""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from _touch_retrieval.files import durable_file
from _touch_retrieval.names import lookup_key
from indexes.errors import AGAIN, CorruptIndex, RowError
from indexes.kinds.vector_index import RowNumbers

TEXT, TABLE = "rows.jsonl", "rows.npy"
RECORD = np.dtype([("stop", "<i8"), ("object", "<i4"), ("original", "<i4")])
"""Entry of a row in the table: the end of its line in the text (where the next line begins), the number of its object,
and the first row with the same content."""


class Row(Struct, frozen=True):
    """One photo of an index.

    Attributes:
        path: Path relative to the catalogue, its id.
        object_id: The object that the photo shows.
        digest: SHA-256 of the file, in hexadecimal.
        metadata: The user's own keys and values.

    >>> indexes.open("index").rows[0].path
    'mug/1.jpg'
    """

    path: str
    object_id: str
    digest: str
    metadata: dict[str, Any] = {}


_DECODER = msgspec.json.Decoder(Row)


class Rows:
    """The N rows of a generation, parsed on access.

    Attributes:
        objects: Number of the object of each row (N,); objects are numbered in the order of their names.
        originals: First row with the same content as each row (N,).
        object_count: Number of objects.
    """

    def __init__(self, text: NDArray[np.uint8], table: NDArray[Any]) -> None:
        self._text, self._stops = text, table["stop"]
        self.objects: RowNumbers = table["object"].astype(np.int64)
        self.originals: RowNumbers = table["original"].astype(np.int64)
        self.object_count = int(self.objects.max()) + 1

    def __len__(self) -> int:
        return len(self._stops)

    def __getitem__(self, number: int) -> Row:
        number = range(len(self))[number]
        start = self._stops[number - 1] if number else 0
        try:
            return _DECODER.decode(self._text[start : self._stops[number]].tobytes())
        except (msgspec.DecodeError, RecursionError) as error:
            raise CorruptIndex(f"row {number} of the index cannot be read ({error}); {AGAIN}") from error

    def __iter__(self) -> Iterator[Row]:
        return map(self.__getitem__, range(len(self)))

    def find(self, path: str) -> int:
        """Return the number of the row with this path; -1 if there is none."""
        number = bisect_left(self, path, key=lambda row: row.path)
        return number if number < len(self) and self[number].path == path else -1

    def find_object(self, name: str) -> int:
        """Return the number of the object with exactly this name; -1 if there is none."""
        number = bisect_left(range(self.object_count), name, key=self.object_name)
        return number if number < self.object_count and self.object_name(number) == name else -1

    def names_like(self, name: str) -> list[str]:
        """Return the name if an object has exactly this one, else the names of objects with its `lookup_key`."""
        return [name] if self.find_object(name) >= 0 else self._names_by_key.get(lookup_key(name), [])

    @cached_property
    def _names_by_key(self) -> dict[str, list[str]]:
        names: dict[str, list[str]] = defaultdict(list)
        for name in map(self.object_name, range(self.object_count)):
            names[lookup_key(name)].append(name)
        return dict(names)

    def object_name(self, number: int) -> str:
        """Return the name of an object."""
        return self[int(self._first_rows[number])].object_id

    @cached_property
    def _first_rows(self) -> RowNumbers:
        """First row of each object."""
        first = np.zeros(self.object_count, np.int64)
        first[self.objects[::-1]] = np.arange(len(self))[::-1]  # the last assignment remains
        return first


def encode_rows(rows: Iterable[Row]) -> bytes:
    """Return the text of rows. Raises `RowError` for metadata that are not JSON."""
    encoder, text = msgspec.json.Encoder(), bytearray()
    for row in rows:
        try:
            text += encoder.encode(row)
        except (TypeError, ValueError, OverflowError, RecursionError) as error:
            raise RowError(f"row {row.path!r} must be JSON ({error})") from error
        text += b"\n"
    return bytes(text)


def write_rows(folder: Path, rows: Sequence[Row]) -> None:
    """Write both files of the rows.

    Raises:
        RowError: There is no row, or the rows are not sorted by path, each once.
    """
    if not rows:
        raise RowError("an index needs at least one row; got none")
    for before, row in pairwise(rows):
        if row.path <= before.path:
            raise RowError(f"rows must be sorted by path, each once; {row.path!r} follows {before.path!r}")
    text = encode_rows(rows)
    table = np.empty(len(rows), RECORD)
    table["stop"] = np.flatnonzero(np.frombuffer(text, np.uint8) == ord("\n")) + 1
    number_of = {name: number for number, name in enumerate(sorted({row.object_id for row in rows}))}
    table["object"] = [number_of[row.object_id] for row in rows]
    first: dict[str, int] = {}
    table["original"] = [first.setdefault(row.digest, number) for number, row in enumerate(rows)]
    with durable_file(folder / TEXT) as file:
        file.write(text)
    with durable_file(folder / TABLE) as file:
        np.save(file, table)


def read_rows(folder: Path) -> Rows:
    """Return the rows of a generation's folder, memory-mapped. Raises CorruptIndex, OSError or ValueError."""
    text = np.asarray(np.memmap(folder / TEXT, np.uint8, "r"))
    table = np.load(folder / TABLE, mmap_mode="r", allow_pickle=False)
    if table.dtype != RECORD or table["stop"][-1] != len(text):
        raise CorruptIndex(f"{folder / TABLE}: does not fit {TEXT}; {AGAIN}")
    return Rows(text, table)
