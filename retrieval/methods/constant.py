"""The constant scorer: every pair is equally good, so every metric must give exactly chance."""

from typing import TYPE_CHECKING

import numpy as np

from retrieval.methods.base import Array, Method

if TYPE_CHECKING:
    from retrieval.training.features import Features


class Constant(Method):
    """Scores of 0: a check of how ties are counted."""

    is_seeded = False

    def _fit(self, train: "Features", validation: "Features") -> None:
        pass

    def _encode_touch(self, touch: Array) -> Array:
        return np.zeros((len(touch), 1), dtype=np.float32)

    def _encode_photo(self, photo: Array) -> Array:
        return np.zeros((len(photo), 1), dtype=np.float32)

    def _score(self, touch_codes: Array, photo_codes: Array) -> Array:
        return np.zeros((len(touch_codes), len(photo_codes)), dtype=np.float32)
