"""The model that one starts from, as it is: on a sensor like its own, no fit to a few objects knows as much."""

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
    """A model that nothing is fitted to, and what its towers make of own grasps in its own preprocessing."""

    start: Checkpoint
    features: Features

    @classmethod
    def of(cls, start: Checkpoint, grasps: list[Grasp], cache: Path | None, quiet: bool) -> "UnadaptedBaseline":
        """A touch of fewer fingers than the model takes is given to each of them."""
        config = replace(start.config.matcher, fingers=len(grasps[0].touches))
        seen = Matcher(config, start.matcher.views).eval()
        seen.touch_tower, seen.photo_tower = start.matcher.touch_tower, start.matcher.photo_tower
        found = encode_recording(grasps, seen, replace(start.config, matcher=config), cache, quiet=quiet)
        fingers = np.arange(start.config.matcher.fingers) % config.fingers
        return cls(start, replace(found, touch=np.ascontiguousarray(found.touch[:, fingers])))

    @one_thread()
    def logits(self, asked: Features) -> NDArray[np.float32]:
        """(n, n) of the touch of every grasp with the photo of every one."""
        matcher, reference_touches = self.start.matcher, self._partials(asked)
        with torch.inference_mode():
            photos = matcher.photo_encoding(torch.from_numpy(asked.photo)).partial.numpy()
        return np.stack([score_partials(matcher.head, partial[None], photos) for partial in reference_touches])

    @torch.inference_mode()
    def _partials(self, asked: Features) -> torch.Tensor:
        return self.start.matcher.touch_encoding(torch.from_numpy(asked.touch).flatten(1)).partial

    def fold_accuracies(self, folds: Sequence[Sequence[str]]) -> list[FoldAccuracy]:
        """How it tells the objects of each fold apart."""
        return [score_accuracy(self.logits(asked), asked) for asked in map(self.features.of_objects, folds)]

    def reference_touches(self, folds: Sequence[Sequence[str]], most: int) -> list[ReferenceTouches]:
        """What its posterior can be fitted on, and what references are worth: of each object at most so many
        touches.
        """
        parts = []
        for asked in map(self.features.of_objects, folds):
            some = asked.select(first_rows(asked, most))
            none = np.eye(len(some), dtype=np.bool_)
            projections = touch_embeddings(self._partials(some).numpy(), self.start.config.matcher.hidden)
            parts.append(ReferenceTouches(ScoredTouches(self.logits(some), some.owner, some.owner, none), projections))
        return parts


def first_rows(features: Features, most: int) -> NDArray[np.int64]:
    """Rows of the first grasps of each object."""
    owner = features.owner
    return np.concatenate([np.flatnonzero(owner == name)[:most] for name in range(owner.max() + 1)])
