"""What a build has made until it was cut off, kept beside the generations for the next one to take up.

    unfinished/<key>.records    records of one size, one after another: digest of the content, arrays, checksum

The key stands for the fingerprint of what makes the arrays and for their layout, so that nothing is ever taken from
another model's build. A record is written whole by one call; one that a kill or a full disk cut short, or that was
altered, fails its checksum and counts as not there. Nothing here belongs to an index: the folder may be deleted at any
time, and is when a generation has been written.
"""

import hashlib
import json
import threading
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval import files
from indexes.errors import WriteFailed
from indexes.store.rows import key_of, keys_of
from indexes.store.tables import Layouts

FOLDER = "unfinished"


class Unfinished:
    """Records by digest, in the folder `index`/unfinished; use it under the index's lock. Threads may share it.

    layouts: name of an array -> dtype and shape of one record's, as in `indexes.store.tables`.
    """

    def __init__(self, index: Path, fingerprint: Mapping[str, str], layouts: Layouts) -> None:
        self.folder, self._layouts = index / FOLDER, layouts
        of = {"fingerprint": dict(fingerprint), "layouts": {name: str(how) for name, how in layouts.items()}}
        key = hashlib.sha256(json.dumps(of, sort_keys=True).encode()).hexdigest()[:32]
        self._path = self.folder / f"{key}.records"
        self._record = np.dtype([("key", "S16"), *((name, *how) for name, how in layouts.items()), ("check", "<u4")])
        self._lock = threading.Lock()
        self._handle: Any = None
        self._known = self._read()
        self._places = {bytes(key): place for place, key in enumerate(self._known["key"])}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._handle is not None:
            self._handle.close()

    def find(self, digests: Iterable[str]) -> dict[str, Any]:
        """Of these digests, those of which an earlier build left a whole record: {digest: record}, which gives its
        arrays by their names."""
        found = {}
        for digest in digests:
            place = self._places.get(key_of(digest).rstrip(b"\0"))  # numpy drops zeros at the end of bytes
            if place is not None and _checksum(record := self._known[place : place + 1])[0] == record["check"][0]:
                found[digest] = record[0].copy()
        return found

    def keep(self, digests: Sequence[str], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write records of these digests: arrays (n, ...) by name. Those that are not finite are left out.

        Raises `WriteFailed` where the disk refuses.
        """
        records = np.zeros(len(digests), self._record)
        records["key"] = keys_of(digests)
        good = np.ones(len(digests), bool)
        for name in self._layouts:
            records[name] = arrays[name]
            good &= np.isfinite(arrays[name]).reshape(len(digests), -1).all(axis=1)
        records["check"] = _checksum(records)
        try:
            with self._lock:
                content = records[good].tobytes()
                if self._open().write(content) < len(content):
                    raise OSError("the disk is full")
        except OSError as error:
            raise WriteFailed(f"{self._path}: the disk refused ({error.strerror or error}); build again") from error

    def clear(self) -> None:
        """Delete what all unfinished builds left: a generation holds it now. What cannot be deleted stays."""
        if self._handle is not None:
            self._handle.close()
            self._handle = None
        if self.folder.is_dir():
            try:
                files.remove_folder(self.folder)
            except OSError:
                return

    def _open(self) -> Any:
        """The file to append to, cut to whole records; unbuffered, so that what is written outlives the process."""
        if self._handle is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._handle = self._path.open("ab", buffering=0)
            self._handle.truncate(self._handle.tell() // self._record.itemsize * self._record.itemsize)
        return self._handle

    def _read(self) -> NDArray[Any]:
        try:
            count = self._path.stat().st_size // self._record.itemsize
            if count and self._path.is_file():
                return np.memmap(self._path, self._record, "r", shape=(count,))
        except OSError:
            pass
        return np.empty(0, self._record)


def _checksum(records: NDArray[Any]) -> NDArray[np.uint32]:
    """Of each record (n,), over all before its last field."""
    size = records.dtype.itemsize
    rows = np.ascontiguousarray(records).view(np.uint8).reshape(len(records), size)
    return np.array([zlib.crc32(row[: size - 4].tobytes()) for row in rows], np.uint32)
