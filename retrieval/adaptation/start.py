"""The model that one starts from, as it is: on a sensor like its own, no fit to a few objects knows as much."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.adaptation.folds import ToldApart, tell_apart
from retrieval.data.dataset import Grasp
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.encode import one_thread
from retrieval.model.fusion import Matcher, score_halves
from retrieval.model.posterior import JudgedTouches
from retrieval.model.references import FeltTouches, touch_codes
from retrieval.training.features import Features, encode_recording


@dataclass(frozen=True, eq=False)
class AsItIs:
    """A model that nothing is fitted to, and what its towers make of own grasps in its own preprocessing."""

    start: Checkpoint
    features: Features

    @classmethod
    def of(cls, start: Checkpoint, grasps: list[Grasp], cache: Path | None, quiet: bool) -> "AsItIs":
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
        matcher, felt = self.start.matcher, self._halves(asked)
        with torch.inference_mode():
            photos = matcher.photo_code(torch.from_numpy(asked.photo)).half.numpy()
        return np.stack([score_halves(matcher.head, half[None], photos) for half in felt])

    @torch.inference_mode()
    def _halves(self, asked: Features) -> torch.Tensor:
        return self.start.matcher.touch_code(torch.from_numpy(asked.touch).flatten(1)).half

    def told(self, folds: Sequence[Sequence[str]]) -> list[ToldApart]:
        """How it tells the objects of each fold apart."""
        return [tell_apart(self.logits(asked), asked) for asked in map(self.features.of_objects, folds)]

    def felt(self, folds: Sequence[Sequence[str]], most: int) -> list[FeltTouches]:
        """What its posterior can be fitted on, and what references are worth: of each object at most so many
        touches."""
        parts = []
        for asked in map(self.features.of_objects, folds):
            some = asked.select(first_rows(asked, most))
            none = np.eye(len(some), dtype=np.bool_)
            codes = touch_codes(self._halves(some).numpy(), self.start.config.matcher.hidden)
            parts.append(FeltTouches(JudgedTouches(self.logits(some), some.owner, some.owner, none), codes))
        return parts


def first_rows(features: Features, most: int) -> NDArray[np.int64]:
    """Rows of the first grasps of each object."""
    owner = features.owner
    return np.concatenate([np.flatnonzero(owner == name)[:most] for name in range(owner.max() + 1)])
