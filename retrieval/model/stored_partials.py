"""Partial activations of photos as an index stores them: float16, and the vectors of cells as 8-bit integers.

A cell's vector has unit length, so one scale serves all: a component c is stored as round(127 c), with an error of at
most 1/254. Arithmetic is in float32.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

PARTIALS, CELLS = "partials", "cells"
"""Names of the two arrays of an index."""
_LARGEST = 127
_BLOCK_ROWS = 8192
Layout = dict[str, tuple[np.dtype[Any], tuple[int, ...]]]


class StoredPartials:
    """Partial activations (N, partial) over the arrays of an index; a selection of rows is float32."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Use the arrays `PARTIALS` (N, pooled) and, with cells, `CELLS` (N, cells * cell_dim)."""
        self._pooled, self._cells = arrays[PARTIALS], arrays.get(CELLS)
        self.pooled_width = self._pooled.shape[1]
        self.shape = (len(self._pooled), self.pooled_width + (0 if self._cells is None else self._cells.shape[1]))

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice | NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the partial activations (n, partial) of some rows."""
        pooled = as_float32(self._pooled[rows])
        if self._cells is None:
            return pooled
        found = np.empty((len(pooled), self.shape[1]), dtype=np.float32)
        found[:, : self.pooled_width] = pooled
        cells = self._cells[rows]
        np.multiply(cells, np.float32(1 / _LARGEST), out=found[:, self.pooled_width :], dtype=np.float32)
        return found


def stored_layout(pooled_width: int, partial_width: int) -> Layout:
    """Return the type and shape of a row of each array."""
    layout: Layout = {PARTIALS: (np.dtype(np.float16), (pooled_width,))}
    if partial_width > pooled_width:
        layout[CELLS] = (np.dtype(np.int8), (partial_width - pooled_width,))
    return layout


def to_stored(partials: NDArray[np.float32], pooled_width: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of partial activations (N, partial), rounded; those beyond float16 become infinite."""
    with np.errstate(over="ignore"):
        arrays: dict[str, NDArray[Any]] = {PARTIALS: partials[:, :pooled_width].astype(np.float16)}
    if partials.shape[1] > pooled_width:
        arrays[CELLS] = np.rint(_LARGEST * partials[:, pooled_width:]).astype(np.int8)
    return arrays


def largest_rounding(partials: NDArray[np.float16]) -> float:
    """Return the largest possible rounding error of stored partial activations (N, pooled), read block by block.

    It is half a unit in the last of the eleven bits of float16's fraction.
    """
    starts = range(0, len(partials), _BLOCK_ROWS)
    return max(float(np.abs(partials[start : start + _BLOCK_ROWS]).max()) for start in starts) * 2.0**-11


Partials = NDArray[np.floating[Any]] | StoredPartials


def as_float32(values: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Return `values` in float32, exactly.

    Partial activations are finite float16. numpy converts these one by one, which takes longer than the arithmetic on
    them. Shifting the five exponent bits and ten fraction bits gives the number divided by 2^112, also for subnormals.
    """
    if values.dtype != np.float16:
        return np.ascontiguousarray(values, dtype=np.float32)
    bits = np.ascontiguousarray(values).view(np.int16)
    if ((bits & _EXPONENT) == _EXPONENT).any():  # NaN or infinite
        return values.astype(np.float32)
    wide = bits.astype(np.int32)  # copies the sign to all upper bits
    wide <<= 13
    wide &= _SIGN_AND_VALUE
    floats: NDArray[np.float32] = wide.view(np.float32)
    floats *= _UNSHIFT
    return floats


_EXPONENT = np.int16(0x7C00)
_SIGN_AND_VALUE = np.int32(0x8FFFE000 - 2**32)
_UNSHIFT = np.float32(2.0**112)
