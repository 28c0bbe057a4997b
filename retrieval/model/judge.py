"""Judging pairs from stored halves, in numpy: what the fusion head does with halves, photos in blocks.

The head's layers after the halves are one matrix product for all photos at once; what comes before and after it is
done in place, so that the product is most of the time.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import NumericalError

Floats = NDArray[np.float32]
Halves = NDArray[np.floating[Any]]
BLOCK = 2048


@dataclass(frozen=True)
class Judge:
    """The layers of a fusion head that follow its halves: `out . relu(second relu(touch + photo) + bias) + out_bias`.

    second (H, H), second_bias (H,), out (H,), out_bias (1,), all float32.
    """

    second: Floats
    second_bias: Floats
    out: Floats
    out_bias: Floats

    def logits(self, touch_halves: Floats, photo_halves: Halves, rows: NDArray[np.int64] | None = None) -> Floats:
        """Sum over grasps of the match logits of the photos at `rows` (all where None): (len(rows),).

        touch_halves (G, H) of G grasps of ONE object; photo_halves (N, H) in any float type, memory-mapped or not,
        read in blocks and reckoned with in float32. Adding logits takes the grasps as independent given the object,
        and a flat prior. Raises NumericalError for a NaN or infinite logit: sorting would rank it first.
        """
        count = len(photo_halves) if rows is None else len(rows)
        scores = np.empty(count, dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # told by name below
            for start in range(0, count, BLOCK):
                part = slice(start, min(start + BLOCK, count))
                photos = photo_halves[part] if rows is None else photo_halves[rows[part]]
                scores[part] = self._sum_of_logits(touch_halves, as_float32(photos))
        _require_finite(scores, rows)
        return scores

    def _sum_of_logits(self, touch_halves: Floats, photos: Floats) -> Floats:
        hidden, second = np.empty_like(photos), np.empty((len(photos), len(self.out)), dtype=np.float32)
        total = np.full(len(photos), len(touch_halves) * self.out_bias[0], dtype=np.float32)
        for touch_half in touch_halves:
            np.add(photos, touch_half, out=hidden)
            np.maximum(hidden, 0, out=hidden)
            np.matmul(hidden, self.second.T, out=second)
            second += self.second_bias
            np.maximum(second, 0, out=second)
            total += second @ self.out
        return total


def _require_finite(scores: Floats, rows: NDArray[np.int64] | None) -> None:
    if not np.isfinite(scores).all():
        bad = int(np.flatnonzero(~np.isfinite(scores))[0])
        name = bad if rows is None else int(rows[bad])
        raise NumericalError(f"every match logit must be finite; photo row {name} has {scores[bad]}")


def as_float32(values: Halves) -> Floats:
    """`values` in float32, exactly. Halves are finite float16, which numpy converts one by one, slower than the
    arithmetic on them: five shifted bits of exponent and ten of fraction are the number over 2^112, subnormals too."""
    if values.dtype != np.float16:
        return np.ascontiguousarray(values, dtype=np.float32)
    bits = np.ascontiguousarray(values).view(np.int16)
    if ((bits & _EXPONENT) == _EXPONENT).any():  # NaN or infinite
        return values.astype(np.float32)
    wide = bits.astype(np.int32)  # the sign is copied to all upper bits
    wide <<= 13
    wide &= _SIGN_AND_VALUE
    floats: Floats = wide.view(np.float32)
    floats *= _UNSHIFT
    return floats


_EXPONENT = np.int16(0x7C00)
_SIGN_AND_VALUE = np.int32(0x8FFFE000 - 2**32)
_UNSHIFT = np.float32(2.0**112)
