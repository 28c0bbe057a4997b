"""Arrays in `.npy` files, written block by block and read by memory mapping."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import finish


class ArrayFile:
    """A `.npy` file that grows row by row; its header with the number of rows is written last."""

    HEADER_BYTES = 256

    def __init__(self, path: Path, dtype: Any, row_shape: tuple[int, ...]) -> None:
        self.path, self.dtype, self.row_shape, self.rows = path, np.dtype(dtype), row_shape, 0
        self._handle = path.open("wb")
        self._handle.write(bytes(self.HEADER_BYTES))

    def append(self, block: NDArray[Any]) -> None:
        """Append rows (n, *row_shape)."""
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
        """Close the file without a header."""
        self._handle.close()


def write_array(path: Path, dtype: Any, row_shape: tuple[int, ...], blocks: Iterable[NDArray[Any]]) -> None:
    """Write a `.npy` file (n, *row_shape) from blocks of rows, with one block in memory at a time."""
    file = ArrayFile(path, dtype, row_shape)
    try:
        for block in blocks:
            file.append(block)
        file.close()
    finally:
        file.abandon()


def open_array(path: Path) -> NDArray[Any]:
    """Return the array in a file, memory-mapped."""
    array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    return array
