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
from retrieval.model.fusion import Matcher, score_partials
from retrieval.model.posterior import ScoredTouches
from retrieval.model.reference_calibration import ReferenceTouches, touch_embeddings
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
    def logits(self, features: Features, *, pooled: bool = False) -> NDArray[np.float32]:
        """Return match logits (n, n) of the touch of every grasp with the photo of every grasp.

        Args:
            features: Features of the n grasps.
            pooled: Score without late interaction.
        """
        matcher, touches = self.start.matcher, self._partials(features)
        with torch.inference_mode():
            photos = matcher.photo_encoding(torch.from_numpy(features.photo)).partial.numpy()
        if pooled:
            photos = photos[:, : matcher.config.pooled_width]
        return np.stack([score_partials(matcher.head, touch[None], photos) for touch in touches])

    @torch.inference_mode()
    def _partials(self, features: Features) -> torch.Tensor:
        return self.start.matcher.touch_encoding(torch.from_numpy(features.touch).flatten(1)).partial

    def fold_accuracies(self, folds: Sequence[Sequence[str]]) -> list[FoldAccuracy]:
        """Return the accuracy of the model among the objects of each fold."""
        return [score_accuracy(self.logits(features), features) for features in map(self.features.of_objects, folds)]

    def reference_touches(
        self, folds: Sequence[Sequence[str]], max_touches: int, *, pooled: bool = False
    ) -> list[ReferenceTouches]:
        """Return the touches of each fold that calibrate the posterior and the reference touches.

        Args:
            folds: Objects of each fold.
            max_touches: Maximum number of touches of one object.
            pooled: Score without late interaction.
        """
        parts = []
        for fold in map(self.features.of_objects, folds):
            features = fold.select(first_rows(fold, max_touches))
            own = np.eye(len(features), dtype=np.bool_)
            projections = touch_embeddings(self._partials(features).numpy(), self.start.config.matcher.cosine_columns)
            scored = ScoredTouches(self.logits(features, pooled=pooled), features.owner, features.owner, own)
            parts.append(ReferenceTouches(scored, projections))
        return parts


def first_rows(features: Features, max_grasps: int) -> NDArray[np.int64]:
    """Return the rows of the first grasps of each object, at most `max_grasps`."""
    owner = features.owner
    return np.concatenate([np.flatnonzero(owner == name)[:max_grasps] for name in range(owner.max() + 1)])
