"""What users run: candidates by the embedding, judged by the match logit; shares late fusion's training."""

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.methods.late_fusion import LateFusion, trained_checkpoint
from retrieval.methods.method import Array, MethodSettings
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.fusion import score_partials
from retrieval.training.distil import feature_partials, with_candidate_encoder
from retrieval.training.features import Features

RERANKED_FRACTION = 0.25


class RetrieveRerank(LateFusion):
    """Search as `retrieve query` does: only the nearest photos by embedding are judged by match logit.

    share: of the gallery that is judged. The others stand behind these, in the order of their embeddings. Of a set the
    photos nearest to all its grasps together are judged, as search does. A model without trained embeddings judges
    every photo. A code is the half and, behind it, the embedding.
    """

    def __init__(self, settings: MethodSettings, reranked_fraction: float = RERANKED_FRACTION) -> None:
        super().__init__(settings)
        self.reranked_fraction = reranked_fraction

    def _fit(self, train: Features, validation: Features) -> None:
        made = trained_checkpoint(self.settings, train, validation)
        if self.settings.config.matcher.candidate_width:
            config = made.config.with_candidate_encoder_of(self.settings.config)
            partials = (feature_partials(made.matcher, part) for part in (train, validation))
            made = with_candidate_encoder(made, config, *partials, quiet=self.settings.quiet)
        self._use_checkpoint(made)

    def _use_checkpoint(self, checkpoint: Checkpoint) -> None:
        super()._use_checkpoint(checkpoint)
        if not checkpoint.config.has_embeddings:
            self.reranked_fraction = 1.0
        self.best_params["reranked_fraction"] = self.reranked_fraction

    @torch.inference_mode()
    def _encode_touch(self, touch: Array) -> Array:
        return np.concatenate(self._matcher.touch_search_encoding(torch.from_numpy(touch).flatten(1)), axis=1)

    @torch.inference_mode()
    def _encode_photo(self, photo: Array) -> Array:
        return np.concatenate(self._matcher.photo_search_encoding(torch.from_numpy(photo)), axis=1)

    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        touch_partials, partials, nearness = self._parts(touch_encodings, photo_encodings)
        scores = []
        for touch_partial, near in zip(torch.from_numpy(touch_partials), nearness, strict=True):
            rows = nearest_photos(near[None], self._count(len(partials)))
            scores.append(
                merge_scores(near[None], rows, score_partials(self._matcher.head, touch_partial[None], partials, rows))
            )
        return np.array(scores)

    def _score_sets(self, touch_encodings: Array, photo_encodings: Array, sets: NDArray[np.int64]) -> Array:
        """As for single touches. Sets share touches, so that here all photos are judged, once for each touch."""
        used, place = np.unique(sets, return_inverse=True)
        touch_partials, partials, nearness = self._parts(touch_encodings[used], photo_encodings)
        logits = super()._score(touch_partials, partials)
        scores = []
        for best_params in place.reshape(sets.shape):
            rows = nearest_photos(nearness[best_params], self._count(len(partials)))
            summed = logits[np.ix_(best_params, rows)].sum(0, dtype=np.float64).astype(np.float32)
            scores.append(merge_scores(nearness[best_params], rows, summed))
        return np.array(scores)

    def _parts(self, touch_encodings: Array, photo_encodings: Array) -> tuple[Array, Array, Array]:
        """Partials of touches and of photos, and cosines (T, N) of their embeddings."""
        partial = self._matcher.config.partial_width
        nearness = touch_encodings[:, partial:] @ photo_encodings[:, partial:].T
        return touch_encodings[:, :partial], np.ascontiguousarray(photo_encodings[:, :partial]), nearness

    def _count(self, photos: int) -> int:
        return max(1, round(self.reranked_fraction * photos))


def merge_scores(nearness: Array, rows: NDArray[np.int64], logits: Array) -> Array:
    """Scores (N,) of all photos: logits of those at `rows`, all others below these by their mean cosine.

    nearness (G, N): cosines of each grasp's embedding with each photo's; they are 1 at most.
    """
    scores = logits.min() - 1 - (1 - nearness.mean(0))
    scores[rows] = logits
    return np.asarray(scores)


def nearest_photos(nearness: Array, count: int) -> NDArray[np.int64]:
    """The `count` photos nearest to all grasps together; equals by row. nearness (G, N)."""
    return np.sort(np.argsort(-nearness.sum(0), kind="stable")[:count])
