"""Late fusion with a learned pooling of the grasps of one object: one match logit for a set of 1..8 touches.

The paper names it as future work. Adding up logits takes grasps as independent; a pooling can learn what repeats.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retrieval.console.progress import Bar
from retrieval.methods.base import Array, Method
from retrieval.methods.draws import ObjectDraws, seeded
from retrieval.methods.selection import Validator, neighbours
from retrieval.methods.standardise import Standardiser
from retrieval.model.fusion import FusionHead
from retrieval.model.losses.match import match_loss
from retrieval.training.fit import Plan, fit_best

if TYPE_CHECKING:
    from retrieval.training.features import Features

MOST_GRASPS, JUDGED_GRASPS = 8, 5
MOST_STEPS, JUDGE_EVERY = 1000, 50
OBJECTS_PER_BATCH, PHOTOS = 24, 4
"""Sets in a batch, and photos of its own object and of other objects that each is paired with."""
PAIRS_PER_BLOCK = 16_384


class SetHead(FusionHead):
    """The paper's head over a pooled touch half.

    The pooling of halves h_1..h_n is `mean + A (attention - mean) + M (max - mean) + log(n) s`: the same for any
    order, defined for any n, and for n = 1 the half itself, so a set of one is judged as late fusion judges a touch.
    A, M and s start at 0.
    """

    def __init__(self, touch_features: int, photo_features: int, hidden: int, dropout: float) -> None:
        super().__init__(touch_features, photo_features, hidden, dropout)
        self.attention = nn.Linear(hidden, 1)
        self.attended, self.largest = (nn.Linear(hidden, hidden, bias=False) for _ in range(2))
        self.size = nn.Parameter(torch.zeros(hidden))
        for layer in (self.attended, self.largest):
            nn.init.zeros_(layer.weight)

    def pool(self, halves: Tensor, held: Tensor) -> Tensor:
        """Pooled halves (S, hidden) of sets (S, G, hidden); held (S, G): which count, at least one of each set."""
        outside = ~held[..., None]
        count = held.sum(1, keepdim=True)
        mean = halves.masked_fill(outside, 0.0).sum(1) / count
        weights = self.attention(torch.relu(halves)).masked_fill(outside, -torch.inf).softmax(1)
        attended = (weights * halves.masked_fill(outside, 0.0)).sum(1)
        largest = halves.masked_fill(outside, -torch.inf).amax(1)
        mixed: Tensor = mean + self.attended(attended - mean) + self.largest(largest - mean)
        return mixed + count.log() * self.size


class SetFusion(Method):
    """Match logits of sets of grasps; the number of steps by ranking on validation objects, sets of 1 and of 5."""

    def _fit(self, train: "Features", validation: "Features") -> None:
        self._touch, self._photo = Standardiser.fit(train.touch), Standardiser.fit(train.photo)
        config = self.setting.config
        steps = min(config.training.iterations, MOST_STEPS)
        plan = Plan(steps, config.training.learning_rate, validate_every=JUDGE_EVERY)
        with seeded(self.setting.seed) as generator:
            features = len(self._touch.kept), len(self._photo.kept)
            self._head = SetHead(*features, config.matcher.hidden, config.matcher.dropout)
            loss, worth = self._training_loss(train, generator), self._worth(validation)
            with Bar("fit set_fusion", steps, "steps", quiet=self.setting.quiet) as bar:
                best = fit_best(self._head, plan, loss, worth, bar=bar)
        self.chosen = {"steps": best.step, "validation_auc": best.value}

    def _training_loss(self, train: "Features", generator: torch.Generator) -> Callable[[int], Tensor]:
        """The loss of a fresh batch: each set with as many photos of its own object as of others."""
        touch, photo = self._touch.tensor(train.touch), self._photo.tensor(train.photo)
        draws = ObjectDraws(torch.from_numpy(train.owner), generator)

        def loss(_: int) -> Tensor:
            objects = draws.distinct_objects(OBJECTS_PER_BATCH)
            rows, held = draws.sets(objects, MOST_GRASPS)
            pooled = self._head.pool(self._head.touch_half(touch[rows]), held)
            shown = torch.cat([objects[:, None].expand(-1, PHOTOS), draws.other_objects(objects, PHOTOS)], 1)
            logits = self._head(pooled[:, None], self._head.photo_half(photo[draws.rows(shown)]))
            return match_loss(logits.flatten(), (shown == objects[:, None]).flatten())

        return loss

    def _worth(self, validation: "Features") -> Callable[[], float]:
        judged = Validator.of(validation)
        groups = neighbours(judged.features.owner, JUDGED_GRASPS)

        def worth() -> float:
            touch, photo = self._encode_touch(judged.features.touch), self._encode_photo(judged.features.photo)
            single = judged.touches(self._score(touch, photo))
            return (single + judged.sets(self._score_sets(touch, photo, groups), groups)) / 2

        return worth

    @torch.inference_mode()
    def _encode_touch(self, touch: Array) -> Array:
        halves: Array = self._head.touch_half(self._touch.tensor(touch)).numpy()
        return halves

    @torch.inference_mode()
    def _encode_photo(self, photo: Array) -> Array:
        halves: Array = self._head.photo_half(self._photo.tensor(photo)).numpy()
        return halves

    def _score(self, touch_codes: Array, photo_codes: Array) -> Array:
        return self._logits(torch.tensor(touch_codes), torch.tensor(photo_codes))

    @torch.inference_mode()
    def _score_sets(self, touch_codes: Array, photo_codes: Array, sets: NDArray[np.int64]) -> Array:
        # In a fixed order: sums in another order round otherwise, and a set has none.
        ordered = torch.tensor(touch_codes)[torch.from_numpy(np.sort(sets, axis=1))]
        pooled = self._head.pool(ordered, torch.ones(sets.shape, dtype=torch.bool))
        return self._logits(pooled, torch.tensor(photo_codes))

    @torch.inference_mode()
    def _logits(self, touch: Tensor, photo: Tensor) -> Array:
        """Match logits (T, N) in blocks: touches by photos by hidden units would not fit into memory."""
        logits = np.empty((len(touch), len(photo)), dtype=np.float32)
        rows = max(PAIRS_PER_BLOCK // max(len(photo), 1), 1)
        for start in range(0, len(touch), rows):
            for first in range(0, len(photo), PAIRS_PER_BLOCK):
                block = self._head(touch[start : start + rows, None], photo[None, first : first + PAIRS_PER_BLOCK])
                logits[start : start + rows, first : first + PAIRS_PER_BLOCK] = block.numpy()
        return logits
