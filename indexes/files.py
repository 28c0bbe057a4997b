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


@contextmanager
def durable(path: Path) -> Iterator[BinaryIO]:
    """A new file to write; flushed to the disk when the block ends."""
    with path.open("wb") as handle:
        yield handle
        handle.flush()
        os.fsync(handle.fileno())


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
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def write_array(path: Path, dtype: Any, shape: tuple[int, ...], blocks: Iterable[NDArray[Any]]) -> None:
    """A `.npy` file of `shape` from blocks of rows, without holding more than one of them."""
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False, "shape": shape}
    with durable(path) as handle:
        np.lib.format.write_array_header_1_0(handle, header)
        for block in blocks:
            handle.write(np.ascontiguousarray(block, dtype=dtype).tobytes())


def write_lines(path: Path, documents: Iterable[Any]) -> None:
    """One JSON document a line."""
    with durable(path) as handle:
        for document in documents:
            handle.write(encoded(document) + b"\n")


def encoded(document: Any, *, indent: int | None = None) -> bytes:
    """JSON in UTF-8. Text that UTF-8 cannot hold (file names of unknown coding) is escaped."""
    try:
        return json.dumps(document, ensure_ascii=False, allow_nan=False, indent=indent).encode()
    except UnicodeEncodeError:
        return json.dumps(document, allow_nan=False, indent=indent).encode()


def check_json(document: Any, what: str, row: str | None = None) -> None:
    """`document` can be stored as JSON and read back the same, or `RowError` naming `what`."""
    try:
        same = json.loads(encoded(document)) == document
    except (ValueError, TypeError, RecursionError) as error:
        raise RowError(f"{what} must be JSON of finite numbers; {error}", row) from error
    if not same:
        raise RowError(f"{what} must read back from JSON as it is: text keys, lists rather than tuples", row)
