"""What users run: candidates by the embedding, judged by the match logit; shares late fusion's training."""

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.methods.base import Array, Setting
from retrieval.methods.late_fusion import LateFusion, trained_checkpoint
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.fusion import score_halves
from retrieval.training.distil import feature_halves, with_pruner
from retrieval.training.features import Features

SHARE = 0.25


class PruneRerank(LateFusion):
    """Search as `retrieve query` does: only the nearest photos by embedding are judged by match logit.

    share: of the gallery that is judged. The others stand behind these, in the order of their embeddings. Of a set the
    photos nearest to all its grasps together are judged, as search does. A model without trained embeddings judges
    every photo. A code is the half and, behind it, the embedding.
    """

    def __init__(self, setting: Setting, share: float = SHARE) -> None:
        super().__init__(setting)
        self.share = share

    def _fit(self, train: Features, validation: Features) -> None:
        made = trained_checkpoint(self.setting, train, validation)
        if self.setting.config.matcher.pruner_width:
            config = made.config.with_pruner_of(self.setting.config)
            halves = (feature_halves(made.matcher, part) for part in (train, validation))
            made = with_pruner(made, config, *halves, quiet=self.setting.quiet)
        self._take(made)

    def _take(self, checkpoint: Checkpoint) -> None:
        super()._take(checkpoint)
        if not checkpoint.config.has_embeddings:
            self.share = 1.0
        self.chosen["judged_share"] = self.share

    @torch.inference_mode()
    def _encode_touch(self, touch: Array) -> Array:
        return np.concatenate(self._matcher.touch_entry(torch.from_numpy(touch).flatten(1)), axis=1)

    @torch.inference_mode()
    def _encode_photo(self, photo: Array) -> Array:
        return np.concatenate(self._matcher.photo_entry(torch.from_numpy(photo)), axis=1)

    def _score(self, touch_codes: Array, photo_codes: Array) -> Array:
        touch_halves, halves, nearness = self._parts(touch_codes, photo_codes)
        scores = []
        for touch_half, near in zip(torch.from_numpy(touch_halves), nearness, strict=True):
            rows = candidates(near[None], self._count(len(halves)))
            scores.append(behind(near[None], rows, score_halves(self._matcher.head, touch_half[None], halves, rows)))
        return np.array(scores)

    def _score_sets(self, touch_codes: Array, photo_codes: Array, sets: NDArray[np.int64]) -> Array:
        """As for single touches. Sets share touches, so that here all photos are judged, once for each touch."""
        used, place = np.unique(sets, return_inverse=True)
        touch_halves, halves, nearness = self._parts(touch_codes[used], photo_codes)
        logits = super()._score(touch_halves, halves)
        scores = []
        for chosen in place.reshape(sets.shape):
            rows = candidates(nearness[chosen], self._count(len(halves)))
            summed = logits[np.ix_(chosen, rows)].sum(0, dtype=np.float64).astype(np.float32)
            scores.append(behind(nearness[chosen], rows, summed))
        return np.array(scores)

    def _parts(self, touch_codes: Array, photo_codes: Array) -> tuple[Array, Array, Array]:
        """Halves of touches and of photos, and cosines (T, N) of their embeddings."""
        half = self._matcher.config.half
        nearness = touch_codes[:, half:] @ photo_codes[:, half:].T
        return touch_codes[:, :half], np.ascontiguousarray(photo_codes[:, :half]), nearness

    def _count(self, photos: int) -> int:
        return max(1, round(self.share * photos))


def behind(nearness: Array, rows: NDArray[np.int64], logits: Array) -> Array:
    """Scores (N,) of all photos: logits of those at `rows`, all others below these by their mean cosine.

    nearness (G, N): cosines of each grasp's embedding with each photo's; they are 1 at most.
    """
    scores = logits.min() - 1 - (1 - nearness.mean(0))
    scores[rows] = logits
    return np.asarray(scores)


def candidates(nearness: Array, count: int) -> NDArray[np.int64]:
    """The `count` photos nearest to all grasps together; equals by row. nearness (G, N)."""
    return np.sort(np.argsort(-nearness.sum(0), kind="stable")[:count])
