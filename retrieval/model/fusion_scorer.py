"""Match logits of the fusion head from stored partial activations, in numpy.

An index stores the partial activations of photos as float16, and the vectors of cells as 8-bit integers: a cell's
vector has unit length, so a component c is stored as round(127 c), with an error of at most 1/254. Arithmetic is in
float32, in blocks of photos.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import NumericalError

Floats = NDArray[np.float32]
BLOCK = 2048
"""Number of photos that are scored together."""
CELL_BLOCK = 64
"""The same for scores of cells, whose vectors then fit into the processor's cache."""
PARTIALS, CELLS = "partials", "cells"
"""Names of the two arrays of an index."""
_LARGEST = 127


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


def stored_layout(pooled_width: int, partial_width: int) -> dict[str, tuple[np.dtype[Any], tuple[int, ...]]]:
    """Return the type and shape of a row of each array."""
    pooled, cells = (np.dtype(np.float16), (pooled_width,)), (np.dtype(np.int8), (partial_width - pooled_width,))
    return {PARTIALS: pooled, CELLS: cells} if partial_width > pooled_width else {PARTIALS: pooled}


def to_stored(partials: NDArray[np.float32], pooled_width: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of partial activations (N, partial), rounded; those beyond float16 become infinite."""
    with np.errstate(over="ignore"):
        arrays: dict[str, NDArray[Any]] = {PARTIALS: partials[:, :pooled_width].astype(np.float16)}
    if partials.shape[1] > pooled_width:
        arrays[CELLS] = np.rint(_LARGEST * partials[:, pooled_width:]).astype(np.int8)
    return arrays


Partials = NDArray[np.floating[Any]] | StoredPartials


def as_float32(values: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Return `values` in float32, exactly.

    numpy converts float16 one by one, which takes longer than the arithmetic on them. Shifting the exponent and
    fraction bits gives the number divided by 2^112, also for subnormals.
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


@dataclass(frozen=True)
class FusionScorer:
    """The layers of a fusion head after its partial activations.

    A partial activation is a concatenation [hidden (H), scaled contrastive embedding (E), vectors of cells]. The match
    logit is `out . relu(second relu(touch_hidden + photo_hidden) + second_bias) + out_bias + touch_embedding .
    photo_embedding + sum over cells i of the touch of max over cells j of the photo of touch_cell_i . photo_cell_j`.
    The second term is a scaled cosine similarity, and E is 0 for a head without it (`cosine`). The last term is left
    out if the photos have no cells.

    Attributes:
        second: (H, H) weights of the second layer. All arrays are float32.
        second_bias: (H,) its bias.
        out: (H,) weights of the output.
        out_bias: (1,) its bias.
        cosine_dim: E.
        cell_dim: Length of a cell's vector; 0 without cells.
    """

    second: Floats
    second_bias: Floats
    out: Floats
    out_bias: Floats
    cosine_dim: int = 0
    cell_dim: int = 0

    @property
    def pooled_width(self) -> int:
        """Width of a partial activation without cells."""
        return len(self.out) + self.cosine_dim

    @property
    def cosine_columns(self) -> slice:
        """The columns of a partial activation that are the scaled embedding."""
        return slice(len(self.out), self.pooled_width)

    def logits(self, touch_partials: Floats, photo_partials: Partials, rows: NDArray[np.int64] | None = None) -> Floats:
        """Return the match logits of photos, summed over grasps: (len(rows),).

        A plain sum: the posterior corrects it for the dependence of grasps. Photos are read in blocks and converted to
        float32.

        Args:
            touch_partials: (G, touch partial) partial activations of G grasps of ONE object.
            photo_partials: (N, partial) of the photos, in any float type or as stored.
            rows: Photos to score; None for all.

        Raises:
            NumericalError: A logit is NaN or infinite: sorting would rank it first.
        """
        count = len(photo_partials) if rows is None else len(rows)
        has_cells = self.cell_dim > 0 and photo_partials.shape[1] > self.pooled_width
        block = CELL_BLOCK if has_cells else BLOCK
        scores = np.empty(count, dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # the check below names the row
            for start in range(0, count, block):
                part = slice(start, min(start + block, count))
                photos = as_float32(photo_partials[part] if rows is None else photo_partials[rows[part]])
                scores[part] = self._sum_of_logits(touch_partials, photos)
                if has_cells:
                    scores[part] += self._sum_of_cell_scores(touch_partials, photos)
        if not np.isfinite(scores).all():
            bad = int(np.flatnonzero(~np.isfinite(scores))[0])
            name = bad if rows is None else int(rows[bad])
            raise NumericalError(f"every match logit must be finite; photo row {name} has {scores[bad]}")
        return scores

    def _sum_of_logits(self, touch_partials: Floats, photos: Floats) -> Floats:
        width = len(self.out)
        hidden, second = (np.empty((len(photos), width), dtype=np.float32) for _ in range(2))
        total: Floats = photos[:, self.cosine_columns] @ touch_partials[:, self.cosine_columns].sum(0)
        total += len(touch_partials) * self.out_bias[0]
        for touch_partial in touch_partials:
            np.add(photos[:, :width], touch_partial[:width], out=hidden)
            np.maximum(hidden, 0, out=hidden)
            np.matmul(hidden, self.second.T, out=second)
            second += self.second_bias
            np.maximum(second, 0, out=second)
            total += second @ self.out
        return total

    def _sum_of_cell_scores(self, touch_partials: Floats, photos: Floats) -> Floats:
        """Return, for each photo, the sum over all touch cells of the largest inner product with one of its cells."""
        touch_cells = np.ascontiguousarray(touch_partials[:, self.pooled_width :]).reshape(-1, self.cell_dim)
        photo_cells = photos[:, self.pooled_width :].reshape(-1, self.cell_dim)
        products = photo_cells @ touch_cells.T
        best: Floats = products.reshape(len(photos), -1, len(touch_cells)).max(1)
        return np.asarray(best.sum(1))
