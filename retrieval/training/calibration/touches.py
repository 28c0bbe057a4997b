"""Touches of objects that a model was not fitted to: the data of its calibrations."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.data.dataset import Grasp
from retrieval.model.fusion import Matcher
from retrieval.model.references import unit_embeddings

Numbers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ScoredTouches:
    """Match logits of touches with photos, to fit a posterior on.

    Attributes:
        logits: (T, N) match logits.
        touch_owner: (T,) object of each touch.
        photo_owner: (N,) object of each photo.
        own: (T, N) whether the photo was taken in the grasp of that touch; such photos are masked for that touch.
    """

    logits: NDArray[np.floating[Any]]
    touch_owner: Numbers
    photo_owner: Numbers
    own: NDArray[np.bool_]


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


def calibration_touches(
    matcher: Matcher,
    grasps: Sequence[Grasp],
    touches: Tensor,
    photos: dict[Path, Tensor],
    *,
    pooled: bool = False,
) -> CalibrationTouches | None:
    """Return the data of the calibrations; None if there are too few objects or photos.

    Args:
        matcher: The matcher.
        grasps: G grasps.
        touches: Touch features (G, fingers * F).
        photos: Features of each photo by file.
        pooled: Score without late interaction, as an index without cells does.
    """
    objects = sorted({grasp.object_id for grasp in grasps})
    object_of = {grasp.photo: grasp.object_id for grasp in grasps}
    own = np.array([[grasp.photo == photo for photo in photos] for grasp in grasps])
    touch_owner = np.array([objects.index(grasp.object_id) for grasp in grasps])
    photo_owner = np.array([objects.index(object_of[photo]) for photo in photos])
    if len(objects) < 3 or not ((touch_owner[:, None] == photo_owner) & ~own).any():
        return None
    with torch.inference_mode():
        touch_partials = matcher.touch_encoding(touches).partial.cpu().numpy()
        encoded = matcher.photo_encoding(torch.stack(list(photos.values())))
    photo_partials, photo_embeddings = encoded.partial.cpu().numpy(), encoded.embedding.cpu().numpy()
    if pooled:
        photo_partials = photo_partials[:, : matcher.config.pooled_width]
    scorer = matcher.head.scorer
    logits = np.stack([scorer.logits(partial[None], photo_partials) for partial in touch_partials])
    embeddings = unit_embeddings(touch_partials, matcher.config.cosine_columns)
    return CalibrationTouches(ScoredTouches(logits, touch_owner, photo_owner, own), embeddings, photo_embeddings)
