"""Retrieve and rerank, as in a user's query: candidates by embedding, scored by match logit; trained as late fusion."""

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.methods.late_fusion import LateFusion, trained_checkpoint
from retrieval.methods.method import Array
from retrieval.model.checkpoint import Checkpoint
from retrieval.training.distil import distil, feature_partials
from retrieval.training.features import Features


class RetrieveRerank(LateFusion):
    """Search as `retrieve query` does: only the nearest photos by embedding get a match logit.

    The other photos follow in the order of their embeddings. For a set of grasps the photos nearest to all of them
    together are reranked. A model without trained embeddings scores every photo. An encoding is the partial activation
    followed by the embedding.
    """

    reranked_fraction = 0.25
    """Fraction of the gallery that is reranked."""

    def _fit(self, train: Features, validation: Features) -> None:
        checkpoint, settings = self.settings.model, self.settings.config
        if checkpoint is None:
            checkpoint = trained_checkpoint(self.settings, train, validation)
            config, matcher = checkpoint.config.with_candidate_encoder_of(settings), checkpoint.matcher
            if config.matcher.candidate_width:
                if self.settings.start:  # its candidate encoder still fits
                    matcher.candidate_encoder = self.settings.start.matcher.candidate_encoder
                    matcher.config = config.matcher
                else:
                    distil(matcher, *feature_partials(matcher, train), config)
                checkpoint = dataclasses.replace(checkpoint, config=config)
        self._use_checkpoint(checkpoint)

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
        scores, scorer = [], self._matcher.head.scorer
        for touch_partial, near in zip(touch_partials, nearness, strict=True):
            rows = self._nearest(near[None])
            scores.append(merge_scores(near[None], rows, scorer.logits(touch_partial[None], partials, rows)))
        return np.array(scores)

    def _score_sets(self, touch_encodings: Array, photo_encodings: Array, sets: NDArray[np.int64]) -> Array:
        """Rerank for a set as for one touch. Sets have touches in common, so all photos are scored once per touch."""
        used, place = np.unique(sets, return_inverse=True)
        touch_partials, partials, nearness = self._parts(touch_encodings[used], photo_encodings)
        logits = super()._score(touch_partials, partials)
        scores = []
        for members in place.reshape(sets.shape):
            rows = self._nearest(nearness[members])
            summed = logits[np.ix_(members, rows)].sum(0, dtype=np.float64).astype(np.float32)
            scores.append(merge_scores(nearness[members], rows, summed))
        return np.array(scores)

    def _parts(self, touch_encodings: Array, photo_encodings: Array) -> tuple[Array, Array, Array]:
        """Return partial activations of touches and of photos, and cosines (T, N) of their embeddings."""
        touch, photo = self._matcher.config.touch_partial_width, self._matcher.config.partial_width
        nearness = touch_encodings[:, touch:] @ photo_encodings[:, photo:].T
        return touch_encodings[:, :touch], np.ascontiguousarray(photo_encodings[:, :photo]), nearness

    def _nearest(self, nearness: Array) -> NDArray[np.int64]:
        """Return the photos to rerank, nearest to all grasps together, from nearness (G, N); among ties the first."""
        count = max(1, round(self.reranked_fraction * nearness.shape[1]))
        return np.sort(np.argsort(-nearness.sum(0), kind="stable")[:count])


def merge_scores(nearness: Array, rows: NDArray[np.int64], logits: Array) -> Array:
    """Return scores (N,): the photos of `rows` by logit, all others below by mean cosine over the grasps."""
    scores = logits.min() - 1 - (1 - nearness.mean(0))
    scores[rows] = logits
    return np.asarray(scores)
