"""Touches of objects that a model was not fitted to: the data of its calibrations."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.model.posterior import ScoredTouches


@dataclass(frozen=True, eq=False)
class CalibrationTouches:
    """Touches of known objects in the order of capture.

    Attributes:
        scored: Match logits of the touches with photos, possibly none.
        touch_embeddings: (T, d) embeddings of the touches; d is 0 for a model whose logit has no cosine.
        photo_embeddings: (N, d') embeddings of the photos.
    """

    scored: ScoredTouches
    touch_embeddings: NDArray[np.floating[Any]]
    photo_embeddings: NDArray[np.floating[Any]]
