"""Before the matcher is asked: is this a gel image at all, and does it feel anything?

Each finger's image is told apart by a linear reading of the touch tower's features (`retrieval.model.gel_head`) into
what the checkpoint saw in training: gels in contact, untouched gels, and pictures that are no gel image. Where a
no-contact frame is given, contact is what differs from it, which needs no model.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.data.resize import RgbImage, resize
from retrieval.errors import BadInput

CONTACT, NO_CONTACT, NOT_A_GEL = "contact", "no contact", "not a gel image"
_BLOCKS = 16
_MOST = 1e6


@dataclass(frozen=True)
class GelCheck:
    """Thresholds, from validation objects; None for what the recording could not teach.

    foreign_above: a finger's log-odds of "no gel image" beyond which a grasp is refused. contact_above: log-odds of
    contact, the larger of the fingers', from which on a grasp has felt something. level_above: the same for what a gel
    image differs from its no-contact frame, in grey levels of 255 (`contact_level`). shares: of what was refused of
    validation touches, untouched gels and foreign pictures.
    """

    foreign_above: float | None
    contact_above: float | None
    level_above: float | None
    shares: Mapping[str, float]

    def judge(self, readings: NDArray[np.float32], levels: NDArray[np.float32] | None = None) -> list[str]:
        """What each grasp is: CONTACT, NO_CONTACT or NOT_A_GEL.

        readings (G, fingers, 2): log-odds of "no gel image" and of contact. levels (G, fingers): grey levels by which
        the images differ from their no-contact frames, where these were given.
        """
        if levels is not None and self.level_above is not None:
            felt = levels.max(1) >= self.level_above
        elif self.contact_above is not None:
            felt = readings[..., 1].max(1) >= self.contact_above
        else:
            felt = np.ones(len(readings), dtype=bool)
        known = np.ones(len(readings), dtype=bool)
        if self.foreign_above is not None:
            known = readings[..., 0].max(1) <= self.foreign_above
        return [
            (CONTACT if feels else NO_CONTACT) if gel else NOT_A_GEL for gel, feels in zip(known, felt, strict=True)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary, as stored in checkpoints."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, data: Any) -> "GelCheck":
        """Inverse of `to_dict`. Raises BadInput for anything else."""
        names = [field.name for field in dataclasses.fields(cls)]
        if not isinstance(data, Mapping) or set(data) != set(names) or not isinstance(data["shares"], Mapping):
            raise BadInput(f"a check of gel images must hold {', '.join(names)}; got {data!r}")
        for name, value in [(name, data[name]) for name in names[:-1] if data[name] is not None] + [
            *data["shares"].items()
        ]:
            if not isinstance(name, str) or type(value) not in (int, float) or not abs(value) <= _MOST:
                raise BadInput(f"a check of gel images must hold finite numbers; {name} is {value!r}")
        return cls(**{**data, "shares": dict(data["shares"])})


def contact_level(touch: RgbImage, untouched: RgbImage) -> float:
    """By how many grey levels of 255 a gel image differs from its no-contact frame, where it differs most.

    Both (H, W, 3) in 0..1; compared in 16 x 16 blocks, whose means leave the noise of single pixels out.
    """
    size = (_BLOCKS, _BLOCKS)
    return 255 * float(np.abs(resize(touch, size) - resize(untouched, size)).max())
