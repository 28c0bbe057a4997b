"""What is judged of codes, in numpy: what a grasp shows, and whether a touch and a photo show one object.

Before the matcher is asked: is this a gel image at all, and does it feel anything? Each finger's image is told apart by
a linear reading of the touch tower's features (`retrieval.model.fusion.GelHead`) into what the checkpoint saw in
training: gels in contact, untouched gels, and pictures that are no gel image. Where a no-contact frame is given,
contact is what differs from it, which needs no model.

Then pairs, from stored halves, photos in blocks: the head's layers after the halves are one matrix product for all
photos at once; what comes before and after it is done in place, so that the product is most of the time.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from _touch_retrieval.documents import typed
from retrieval.data.resize import RgbImage, resize
from retrieval.errors import BadInput, NumericalError

CONTACT, NO_CONTACT, NOT_A_GEL = "contact", "no contact", "not a gel image"
BLOCKS = 16
Bounded = Annotated[float, Meta(ge=-1e6, le=1e6)]


@dataclass(frozen=True)
class GelCheck:
    """Thresholds, from validation objects; None for what the recording could not teach.

    foreign_above: a finger's log-odds of "no gel image" beyond which a grasp is refused. contact_above: log-odds of
    contact, the larger of the fingers', from which on a grasp has felt something. level_above: the same for what a gel
    image differs from its no-contact frame, in grey levels of 255 (`contact_level`). shares: of what was refused of
    validation touches, untouched gels and foreign pictures.
    """

    foreign_above: Bounded | None
    contact_above: Bounded | None
    level_above: Bounded | None
    rates: Mapping[str, Bounded]

    def classify(self, readings: NDArray[np.float32], levels: NDArray[np.float32] | None = None) -> list[str]:
        """What each grasp is: CONTACT, NO_CONTACT or NOT_A_GEL.

        readings (G, fingers, 2): log-odds of "no gel image" and of contact. levels (G, fingers): grey levels by which
        the images differ from their no-contact frames, where these were given.
        """
        if levels is not None and self.level_above is not None:
            has_contact = levels.max(1) >= self.level_above
        elif self.contact_above is not None:
            has_contact = readings[..., 1].max(1) >= self.contact_above
        else:
            has_contact = np.ones(len(readings), dtype=bool)
        known = np.ones(len(readings), dtype=bool)
        if self.foreign_above is not None:
            known = readings[..., 0].max(1) <= self.foreign_above
        return [
            (CONTACT if feels else NO_CONTACT) if gel else NOT_A_GEL
            for gel, feels in zip(known, has_contact, strict=True)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary, as stored in checkpoints."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, data: Any) -> "GelCheck":
        """Inverse of `to_dict`. Raises BadInput for anything else."""
        return typed(data, cls, "gel_check", complete=True, error=BadInput)


def contact_level(touch: RgbImage, no_contact: RgbImage) -> float:
    """By how many grey levels of 255 a gel image differs from its no-contact frame, where it differs most.

    Both (H, W, 3) in 0..1; compared in 16 x 16 blocks, whose means leave the noise of single pixels out.
    """
    size = (BLOCKS, BLOCKS)
    return 255 * float(np.abs(resize(touch, size) - resize(no_contact, size)).max())


Floats = NDArray[np.float32]
Partials = NDArray[np.floating[Any]]
BLOCK = 2048


@dataclass(frozen=True)
class FusionScorer:
    """The layers of a fusion head that follow its halves: `out . relu(second relu(touch + photo) + bias) + out_bias`,
    of the first H numbers; what follows them in a half adds its inner product.

    second (H, H), second_bias (H,), out (H,), out_bias (1,), all float32.
    """

    second: Floats
    second_bias: Floats
    out: Floats
    out_bias: Floats

    def logits(self, touch_partials: Floats, photo_partials: Partials, rows: NDArray[np.int64] | None = None) -> Floats:
        """Sum over grasps of the match logits of the photos at `rows` (all where None): (len(rows),).

        touch_partials (G, half) of G grasps of ONE object; photo_partials (N, half) in any float type, memory-mapped or
        not, read in blocks and computed with in float32. Adding logits takes the grasps as independent given the
        object, and a flat prior. Raises NumericalError for a NaN or infinite logit: sorting would rank it first.
        """
        count = len(photo_partials) if rows is None else len(rows)
        scores = np.empty(count, dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # told by name below
            for start in range(0, count, BLOCK):
                part = slice(start, min(start + BLOCK, count))
                photos = photo_partials[part] if rows is None else photo_partials[rows[part]]
                scores[part] = self._sum_of_logits(touch_partials, as_float32(photos))
        if not np.isfinite(scores).all():
            bad = int(np.flatnonzero(~np.isfinite(scores))[0])
            name = bad if rows is None else int(rows[bad])
            raise NumericalError(f"every match logit must be finite; photo row {name} has {scores[bad]}")
        return scores

    def _sum_of_logits(self, touch_partials: Floats, photos: Floats) -> Floats:
        width = len(self.out)
        hidden, second = (np.empty((len(photos), width), dtype=np.float32) for _ in range(2))
        total: Floats = photos[:, width:] @ touch_partials[:, width:].sum(0)
        total += len(touch_partials) * self.out_bias[0]
        for touch_partial in touch_partials:
            np.add(photos[:, :width], touch_partial[:width], out=hidden)
            np.maximum(hidden, 0, out=hidden)
            np.matmul(hidden, self.second.T, out=second)
            second += self.second_bias
            np.maximum(second, 0, out=second)
            total += second @ self.out
        return total


def as_float32(values: Partials) -> Floats:
    """`values` in float32, exactly. Partials are finite float16, which numpy converts one by one, slower than the
    arithmetic on them: five shifted bits of exponent and ten of fraction are the number over 2^112, subnormals too.
    """
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
