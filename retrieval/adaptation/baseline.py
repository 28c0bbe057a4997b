"""The unadapted start model as a baseline: on a similar sensor it is better than a fit to a few objects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.adaptation.folds import FoldAccuracy, score_accuracy
from retrieval.data.dataset import Grasp
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import one_thread
from retrieval.model.fusion import ImageEncoding, Matcher
from retrieval.model.references import unit_embeddings
from retrieval.training.calibration.touches import CalibrationTouches, ScoredTouches
from retrieval.training.features import Features, encode_recording


@dataclass(frozen=True, eq=False)
class UnadaptedBaseline:
    """A start model without any fit, and the features of the recorded grasps with its own preprocessing.

    Attributes:
        start: The model.
        features: Tower features of the grasps.
    """

    start: Checkpoint
    features: Features

    @classmethod
    def of(cls, start: Checkpoint, grasps: list[Grasp], cache: Path | None, quiet: bool) -> "UnadaptedBaseline":
        """Encode the grasps; if the model has more fingers than a grasp, the touches are repeated."""
        config = replace(start.config.matcher, fingers=len(grasps[0].touches))
        encoder = Matcher(config, start.matcher.views).eval()
        encoder.touch_tower, encoder.photo_tower = start.matcher.touch_tower, start.matcher.photo_tower
        found = encode_recording(grasps, encoder, replace(start.config, matcher=config), cache, quiet=quiet)
        fingers = np.arange(start.config.matcher.fingers) % config.fingers
        return cls(start, replace(found, touch=np.ascontiguousarray(found.touch[:, fingers])))

    @one_thread()
    def fold_accuracies(self, folds: Sequence[Sequence[str]]) -> list[FoldAccuracy]:
        """Return the accuracy of the model among the objects of each fold."""
        return [
            score_accuracy(self._logits(*self._encoded(features)), features)
            for features in map(self.features.of_objects, folds)
        ]

    @torch.inference_mode()
    def _encoded(self, features: Features) -> tuple[ImageEncoding, ImageEncoding]:
        matcher = self.start.matcher
        touches = matcher.touch_encoding(torch.from_numpy(features.touch).flatten(1))
        return touches, matcher.photo_encoding(torch.from_numpy(features.photo))

    def _logits(self, touches: ImageEncoding, photos: ImageEncoding, *, pooled: bool = False) -> NDArray[np.float32]:
        """Return match logits (n, n) of every touch with every photo; `pooled`: without late interaction."""
        matcher, partials = self.start.matcher, photos.partial.numpy()
        if pooled:
            partials = partials[:, : matcher.config.pooled_width]
        return np.stack([matcher.head.scorer.logits(touch[None], partials) for touch in touches.partial.numpy()])

    @one_thread()
    def calibration_touches(
        self, folds: Sequence[Sequence[str]], max_touches: int, *, pooled: bool = False
    ) -> list[CalibrationTouches]:
        """Return the touches of each fold, at most `max_touches` of an object; `pooled`: without late interaction."""
        parts = []
        for fold in map(self.features.of_objects, folds):
            rows = [np.flatnonzero(fold.owner == name)[:max_touches] for name in range(fold.owner.max() + 1)]
            features = fold.select(np.concatenate(rows))
            own = np.eye(len(features), dtype=np.bool_)
            touches, photos = self._encoded(features)
            logits = self._logits(touches, photos, pooled=pooled)
            embeddings = unit_embeddings(touches.partial.numpy(), self.start.config.matcher.cosine_columns)
            scored = ScoredTouches(logits, features.owner, features.owner, own)
            parts.append(CalibrationTouches(scored, embeddings, photos.embedding.numpy()))
        return parts
