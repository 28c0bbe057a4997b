"""Late fusion with a learned pooling of the grasps of one object: one match logit for a set of 1..8 touches.

The paper names it as future work. Adding logits assumes independent grasps; a pooling can learn their redundancy.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retrieval.console.progress import Bar
from retrieval.methods.method import Array, Method
from retrieval.methods.object_sampler import ObjectSampler, seeded_generator
from retrieval.methods.selection import Validator, next_rows_of_object
from retrieval.methods.standardise import Standardiser
from retrieval.model.fusion import FusionHead
from retrieval.model.losses.match import match_loss
from retrieval.training.fit import Plan, fit_best

if TYPE_CHECKING:
    from retrieval.training.features import Features

MAX_GRASPS, VALIDATION_GRASPS = 8, 5
MAX_STEPS, VALIDATE_EVERY = 1000, 50
OBJECTS_PER_BATCH, PHOTOS = 24, 4
"""Sets in a batch; for each set, the number of photos of its own object, and of photos of other objects."""
PAIRS_PER_BLOCK = 16_384


class SetHead(FusionHead):
    """The paper's head over a pooled touch partial activation.

    The pooling of h_1..h_n is `mean + A (attention - mean) + M (max - mean) + log(n) s`. It does not depend on the
    order and is defined for any n. For n = 1 it is the identity, so a set of one is scored like a touch in late fusion.
    A, M and s start at 0.
    """

    def __init__(self, touch_features: int, photo_features: int, hidden: int, dropout: float) -> None:
        super().__init__(touch_features, photo_features, hidden, dropout)
        self.attention = nn.Linear(hidden, 1)
        self.attended, self.largest = (nn.Linear(hidden, hidden, bias=False) for _ in range(2))
        self.size = nn.Parameter(torch.zeros(hidden))
        for layer in (self.attended, self.largest):
            nn.init.zeros_(layer.weight)

    def pool(self, partials: Tensor, counted: Tensor) -> Tensor:
        """Return pooled partial activations (S, hidden) of sets (S, G, hidden).

        Args:
            partials: Partial activations of the touches.
            counted: (S, G) mask of the members, at least one per set.
        """
        outside = ~counted[..., None]
        count = counted.sum(1, keepdim=True)
        mean = partials.masked_fill(outside, 0.0).sum(1) / count
        weights = self.attention(torch.relu(partials)).masked_fill(outside, -torch.inf).softmax(1)
        attended = (weights * partials.masked_fill(outside, 0.0)).sum(1)
        largest = partials.masked_fill(outside, -torch.inf).amax(1)
        mixed: Tensor = mean + self.attended(attended - mean) + self.largest(largest - mean)
        return mixed + count.log() * self.size


class SetFusion(Method):
    """Match logits of sets of grasps; steps are chosen by ranking on validation objects, with sets of 1 and of 5."""

    def _fit(self, train: "Features", validation: "Features") -> None:
        self._touch, self._photo = Standardiser.fit(train.touch), Standardiser.fit(train.photo)
        config = self.settings.config
        steps = min(config.training.iterations, MAX_STEPS)
        plan = Plan(steps, config.training.learning_rate, validate_every=VALIDATE_EVERY)
        with seeded_generator(self.settings.seed) as generator:
            features = len(self._touch.columns), len(self._photo.columns)
            self._head = SetHead(*features, config.matcher.hidden, config.matcher.dropout)
            loss, validation_auc = self._training_loss(train, generator), self._validation_auc(validation)
            with Bar("fit set_fusion", steps, "steps", quiet=self.settings.quiet) as bar:
                best = fit_best(self._head, plan, loss, validation_auc, bar=bar)
        self.best_params = {"steps": best.step, "validation_auc": best.value}

    def _training_loss(self, train: "Features", generator: torch.Generator) -> Callable[[int], Tensor]:
        """Return the loss of a fresh batch: each set with as many photos of its own object as of others."""
        touch, photo = self._touch.tensor(train.touch), self._photo.tensor(train.photo)
        draws = ObjectSampler(torch.from_numpy(train.owner), generator)

        def loss(_: int) -> Tensor:
            objects = draws.distinct_objects(OBJECTS_PER_BATCH)
            rows, counted = draws.sets(objects, MAX_GRASPS)
            pooled = self._head.pool(self._head.touch_partial(touch[rows]), counted)
            photo_objects = torch.cat([objects[:, None].expand(-1, PHOTOS), draws.other_objects(objects, PHOTOS)], 1)
            logits = self._head(pooled[:, None], self._head.photo_partial(photo[draws.rows(photo_objects)]))
            return match_loss(logits.flatten(), (photo_objects == objects[:, None]).flatten())

        return loss

    def _validation_auc(self, validation: "Features") -> Callable[[], float]:
        validator = Validator.of(validation)
        groups = next_rows_of_object(validator.features.owner, VALIDATION_GRASPS)

        def validation_auc() -> float:
            touch, photo = self._encode_touch(validator.features.touch), self._encode_photo(validator.features.photo)
            single = validator.touch_auc(self._score(touch, photo))
            return (single + validator.set_auc(self._score_sets(touch, photo, groups), groups)) / 2

        return validation_auc

    @torch.inference_mode()
    def _encode_touch(self, touch: Array) -> Array:
        partials: Array = self._head.touch_partial(self._touch.tensor(touch)).numpy()
        return partials

    @torch.inference_mode()
    def _encode_photo(self, photo: Array) -> Array:
        partials: Array = self._head.photo_partial(self._photo.tensor(photo)).numpy()
        return partials

    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        return self._logits(torch.tensor(touch_encodings), torch.tensor(photo_encodings))

    @torch.inference_mode()
    def _score_sets(self, touch_encodings: Array, photo_encodings: Array, sets: NDArray[np.int64]) -> Array:
        # Sorted, because the rounding of sums depends on their order and a set has none.
        ordered = torch.tensor(touch_encodings)[torch.from_numpy(np.sort(sets, axis=1))]
        pooled = self._head.pool(ordered, torch.ones(sets.shape, dtype=torch.bool))
        return self._logits(pooled, torch.tensor(photo_encodings))

    @torch.inference_mode()
    def _logits(self, touch: Tensor, photo: Tensor) -> Array:
        """Return match logits (T, N) in blocks: touches x photos x hidden units would not fit into memory."""
        logits = np.empty((len(touch), len(photo)), dtype=np.float32)
        rows = max(PAIRS_PER_BLOCK // max(len(photo), 1), 1)
        for start in range(0, len(touch), rows):
            for first in range(0, len(photo), PAIRS_PER_BLOCK):
                block = self._head(touch[start : start + rows, None], photo[None, first : first + PAIRS_PER_BLOCK])
                logits[start : start + rows, first : first + PAIRS_PER_BLOCK] = block.numpy()
        return logits
