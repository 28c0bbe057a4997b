"""Touches of objects that a model was not fitted to, scored with photos: what calibrations are fitted on."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
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
Embeddings = NDArray[np.floating[Any]]
MIN_OBJECTS = 3
"""Smallest number of objects of a fit; with two objects, every catalogue would have only one."""
_NO_EMBEDDINGS = np.zeros((0, 0), np.float32)


@dataclass(frozen=True, eq=False)
class ScoredTouches:
    """Touches of known objects in the order of capture, and their match logits with photos, possibly none.

    Attributes:
        logits: (T, N) match logits.
        touch_owner: (T,) object of each touch.
        photo_owner: (N,) object of each photo.
        own: (T, N) whether the photo was taken in the grasp of that touch; such photos are masked for that touch.
        touch_embeddings: (T, d) embeddings, for the calibration of reference touches; d is 0 for a model whose logit
            has no cosine.
        photo_embeddings: (N, d') embeddings, for verification.
        touch_group: (T,) number of the session or sequence of each touch, in the order of capture. Then reference
            touches and queries are of different ones.
        pooled: The same without late interaction, as in an index without cells; None for a model without cells.
    """

    logits: NDArray[np.floating[Any]]
    touch_owner: Numbers
    photo_owner: Numbers
    own: NDArray[np.bool_]
    touch_embeddings: Embeddings = field(default_factory=lambda: _NO_EMBEDDINGS)
    photo_embeddings: Embeddings = field(default_factory=lambda: _NO_EMBEDDINGS)
    touch_group: Numbers | None = None
    pooled: "ScoredTouches | None" = None

    @property
    def has_trials(self) -> bool:
        """Whether a posterior can be fitted: to three objects, and a touch with another photo of its object."""
        same = self.touch_owner[:, None] == self.photo_owner
        return len(np.unique(self.photo_owner)) >= MIN_OBJECTS and bool((same & ~self.own).any())

    def without_evidence(self, refused: NDArray[np.bool_]) -> "ScoredTouches":
        """Return these touches; those that the gel check refuses (T,) have the median logit with every photo."""
        logits = np.where(refused[:, None], np.median(self.logits), self.logits)
        return dataclasses.replace(self, logits=logits)

    def draw_sets(self, grasps: int, draws: int | None, rng: np.random.Generator) -> Numbers:
        """Return `draws` random sets (S, grasps) of each object that has so many touches and a photo of another grasp.

        Without `draws`, the sets are each single touch.
        """
        sets = []
        for name in np.unique(self.touch_owner):
            touches, photos = np.flatnonzero(self.touch_owner == name), self.photo_owner == name
            drawn = touches[:, None] if draws is None else [rng.permutation(touches)[:grasps] for _ in range(draws)]
            sets += [rows for rows in drawn if len(rows) == grasps and (photos & ~self.own[rows].any(0)).any()]
        return np.array(sets, dtype=np.int64).reshape(-1, grasps)


@torch.inference_mode()
def score_touches(
    matcher: Matcher,
    features: tuple[Tensor, Tensor],
    owners: tuple[Numbers, Numbers],
    own: NDArray[np.bool_],
    touch_group: Numbers | None = None,
) -> ScoredTouches:
    """Score touches with photos, given their features (T, fingers * F) and (N, F') and their objects (T,) and (N,)."""
    touch_partials = matcher.touch_encoding(features[0]).partial.cpu().numpy()
    photo_partials, photo_embeddings = (part.cpu().numpy() for part in matcher.photo_encoding(features[1]))
    scorer = matcher.head.scorer
    touch_embeddings = unit_embeddings(touch_partials, scorer.cosine_columns)

    def scored(photos: Embeddings) -> ScoredTouches:
        logits = np.stack([scorer.logits(partial[None], photos) for partial in touch_partials])
        return ScoredTouches(logits, *owners, own, touch_embeddings, photo_embeddings, touch_group)

    pooled = scored(photo_partials[:, : scorer.pooled_width]) if matcher.config.cell_dim else None
    return dataclasses.replace(scored(photo_partials), pooled=pooled)


def score_grasps(
    matcher: Matcher, grasps: Sequence[Grasp], touches: Tensor, photos: dict[Path, Tensor]
) -> ScoredTouches | None:
    """Score the touches of grasps with their photos (`recorded_features`); None for too few objects or photos."""
    touch_owner = np.unique([grasp.object_id for grasp in grasps], return_inverse=True)[1]
    owner_of = {grasp.photo: owner for grasp, owner in zip(grasps, touch_owner, strict=True)}
    owners = touch_owner, np.array([owner_of[photo] for photo in photos])
    own = np.array([[grasp.photo == photo for photo in photos] for grasp in grasps])
    scored = score_touches(matcher, (touches, torch.stack(list(photos.values()))), owners, own)
    return scored if scored.has_trials else None
