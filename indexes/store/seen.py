"""What builds saw of the files behind the rows: a file that looks as it did need not be read again.

    seen.records    a record a file: keys of the row's id and of its content's digest, and how the file looked

Each record is a fact of its own, "a file that looks so has this content", whatever generation is current. The file
belongs to none and may be deleted at any time: then all is read once more. So is one that was altered or cut short.
"""

import hashlib
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval import files
from _touch_retrieval.files import read_regular
from indexes.store.rows import first_equal

NAME = "seen.records"
LOOKS = ("bytes", "mtime_ns", "ctime_ns", "inode")
"""How a file looks without being read, each modulo 2^64."""
SETTLED_NS = 2 * 10**9
"""What is noted must have been left alone for so long: the coarsest clock of a common disk, FAT's, ticks every two
seconds."""
RECORD = np.dtype([("id", "S16"), ("digest", "S16"), ("looks", "<u8", (len(LOOKS),))])

_MAGIC = b"seen 1\n\0"
_MOST_BYTES = 2**33

Keys: TypeAlias = NDArray[np.bytes_]
Looks: TypeAlias = NDArray[np.uint64]


class Seen:
    """The records in the folder of an index; use it under the index's lock. records (N,) of `RECORD`."""

    def __init__(self, index: Path) -> None:
        self._path = index / NAME
        self.records = self._read()

    def digests(self, ids: Keys, looks: Looks) -> Keys:
        """For each file, by its row's id and how it looks (N, 4), the key of its content's digest; b"" where it looks
        otherwise than it did, or was never seen."""
        found = np.zeros(len(ids), "S16")
        if len(self.records):
            number = first_equal(np.ascontiguousarray(self.records["id"]), ids)
            same = (number >= 0) & (self.records["looks"][number] == looks).all(axis=1)
            found[same] = self.records["digest"][number[same]]
        return found

    def write(self, ids: Keys, digests: Keys, looks: Looks) -> None:
        """Put these records (N,) in the place of all others. Raises OSError where the disk refuses."""
        records = np.zeros(len(ids), RECORD)
        records["id"], records["digest"], records["looks"] = ids, digests, looks
        if (body := records.tobytes()) != self.records.tobytes():
            content = _MAGIC + body
            files.write_atomically(self._path, content + hashlib.sha256(content).digest())
        self.records = records

    def _read(self) -> NDArray[np.void]:
        try:
            content = read_regular(self._path, _MOST_BYTES)
        except OSError:
            content = b""
        body, check = content[:-32], content[-32:]
        whole = body.startswith(_MAGIC) and (len(body) - len(_MAGIC)) % RECORD.itemsize == 0
        if not whole or hashlib.sha256(body).digest() != check:
            return np.empty(0, RECORD)
        return np.frombuffer(body, RECORD, offset=len(_MAGIC))
