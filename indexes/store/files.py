"""Files that survive a crash: written whole, flushed to the disk, and named only then."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from indexes.errors import RowError
from indexes.store.regular import DEEPEST, is_deep, open_regular


@contextmanager
def durable(path: Path) -> Iterator[BinaryIO]:
    """A new file to write; flushed to the disk when the block ends."""
    with path.open("wb") as handle:
        yield handle
        finish(handle)


def finish(handle: BinaryIO) -> None:
    """Flush what was written to the disk, and close the file."""
    handle.flush()
    os.fsync(handle.fileno())
    handle.close()


def sync(path: Path) -> None:
    """Flush a file or a folder (its names) to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_text(path: Path, text: str) -> None:
    """Give `path` the content `text`: readers see the old or the new, whole, whenever the power fails."""
    beside = path.with_name(f"{path.name}.tmp-{os.getpid()}")
    with durable(beside) as handle:
        handle.write(text.encode())
    beside.replace(path)
    sync(path.parent)


def remove_folder(folder: Path) -> None:
    """Delete a folder; renamed first, so that a half-deleted one is never taken for a whole one."""
    doomed = folder
    if ".tmp-" not in folder.name:
        doomed = folder.with_name(f"{folder.name}.tmp-{os.getpid()}")
        folder.rename(doomed)
    shutil.rmtree(doomed)


def digest(path: Path) -> str:
    """SHA-256 of a regular file, in hexadecimal."""
    with open_regular(path) as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


class ArrayFile:
    """A `.npy` file that grows row by row; its header, written last, says how many rows there are."""

    HEADER_BYTES = 256

    def __init__(self, path: Path, dtype: Any, row_shape: tuple[int, ...]) -> None:
        self.path, self.dtype, self.row_shape, self.rows = path, np.dtype(dtype), row_shape, 0
        self._handle = path.open("wb")
        self._handle.write(bytes(self.HEADER_BYTES))

    def append(self, block: NDArray[Any]) -> None:
        """Add rows (n, *row_shape)."""
        self._handle.write(np.ascontiguousarray(block, dtype=self.dtype).data.cast("B") if len(block) else b"")
        self.rows += len(block)

    def close(self) -> None:
        """Write the header and flush the file to the disk."""
        descr = np.lib.format.dtype_to_descr(self.dtype)
        header = {"descr": descr, "fortran_order": False, "shape": (self.rows, *self.row_shape)}
        prefix, text = np.lib.format.magic(1, 0), repr(header).encode()
        room = self.HEADER_BYTES - len(prefix) - 2
        self._handle.seek(0)
        self._handle.write(prefix + room.to_bytes(2, "little") + text.ljust(room - 1) + b"\n")
        finish(self._handle)

    def abandon(self) -> None:
        """Close without finishing."""
        self._handle.close()


def write_array(path: Path, dtype: Any, row_shape: tuple[int, ...], blocks: Iterable[NDArray[Any]]) -> None:
    """A `.npy` file (n, *row_shape) from blocks of rows, without holding more than one of them."""
    file = ArrayFile(path, dtype, row_shape)
    try:
        for block in blocks:
            file.append(block)
        file.close()
    finally:
        file.abandon()


def encoded(document: Any, *, indent: int | None = None) -> bytes:
    """JSON in UTF-8. Text that UTF-8 cannot hold (file names of unknown coding) is escaped."""
    try:
        return json.dumps(document, ensure_ascii=False, allow_nan=False, indent=indent).encode()
    except UnicodeEncodeError:
        return json.dumps(document, allow_nan=False, indent=indent).encode()


def check_json(document: Any, what: str, row: str | None = None) -> None:
    """`document` can be stored as JSON and read back the same, or `RowError` naming `what`."""
    if is_deep(document):
        raise RowError(f"{what} must not be nested deeper than {DEEPEST} levels", row)
    try:
        same = json.loads(encoded(document)) == document
    except (ValueError, TypeError, RecursionError) as error:
        raise RowError(f"{what} must be JSON of finite numbers; {error}", row) from error
    if not same:
        raise RowError(f"{what} must read back from JSON as it is: text keys, lists rather than tuples", row)
