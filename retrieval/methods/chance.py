"""Random scores, which show the value of every metric by chance."""

from hashlib import blake2b

import numpy as np

from retrieval.methods.method import Array, Method
from retrieval.training.features import Features

DIM = 64


class Chance(Method):
    """Cosines of random directions; each depends only on the seed and on the bytes of the touch or photo.

    Scores are thus independent of other items, of their order and of the batch.
    """

    def _fit(self, train: Features, validation: Features) -> None:
        pass

    def _encode_touch(self, touch: Array) -> Array:
        return self._directions(0, touch)

    def _encode_photo(self, photo: Array) -> Array:
        return self._directions(1, photo)

    def _directions(self, modality: int, items: Array) -> Array:
        drawn = np.empty((len(items), DIM), dtype=np.float32)
        for row, item in enumerate(items):
            content = int.from_bytes(blake2b(item.tobytes(), digest_size=8).digest())
            drawn[row] = np.random.default_rng([self.settings.seed, modality, content]).standard_normal(DIM)
        return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))
