"""Two projections into one metric space, trained by a contrastive loss on fixed tower features."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from retrieval.methods.method import Array, Method
from retrieval.model.fusion import LOG_SCALE_INIT, LOG_SCALE_MAX
from retrieval.model.losses.listwise import contrastive_loss
from retrieval.training.cca import Standardiser
from retrieval.training.features import Features
from retrieval.training.loop import BestStep, Plan, train_loop
from retrieval.training.selection import ranking_auc, validation_rows

STEPS, VALIDATE_EVERY = 200, 20
LEARNING_RATE = 1e-3
OBJECTS_PER_BATCH, IMAGES_PER_OBJECT = 64, 2
"""A batch contains each object at most once, with IMAGES_PER_OBJECT of its touches and of its photos."""
REGULARISATIONS = ((0.5, 0.0), (0.8, 0.0), (0.8, 1.0))
"""Pairs of feature dropout and weight decay to choose from."""


class Projections(nn.Module):
    """Linear maps from standardised features to unit embeddings, as in the matcher, with dropout before them."""

    def __init__(self, touch_features: int, photo_features: int, dim: int, dropout: float) -> None:
        super().__init__()
        self.dropout = nn.Dropout(dropout)
        self.touch, self.photo = nn.Linear(touch_features, dim), nn.Linear(photo_features, dim)
        self.log_scale = nn.Parameter(torch.tensor(LOG_SCALE_INIT))

    def forward(self, features: Tensor, projection: nn.Linear) -> Tensor:
        """Return unit embeddings (B, dim) of features (B, F)."""
        return functional.normalize(projection(self.dropout(features)), dim=-1, eps=1e-6)

    @torch.no_grad()
    def clamp_scale(self) -> None:
        """Clamp the scale to 1..100. The parameter is clamped, so that its gradient can reduce it again."""
        self.log_scale.clamp_(0.0, LOG_SCALE_MAX)


class ContrastiveEmbedding(Method):
    """Scaled cosine of InfoNCE embeddings; regularisation and steps are chosen by ranking on validation objects."""

    def _fit(self, train: Features, validation: Features) -> None:
        self._touch, self._photo = Standardiser.fit(train.touch), Standardiser.fit(train.photo)
        chosen = validation.select(validation_rows(validation))
        fits = [self._train(train, chosen, place) for place in range(len(REGULARISATIONS))]
        aucs = [best.metrics["validation_auc"] for _, best in fits]
        place = aucs.index(max(aucs))
        self._module, best = fits[place]
        self._scale = self._module.log_scale.exp().item()
        self.best_params = {
            "dropout": REGULARISATIONS[place][0],
            "weight_decay": REGULARISATIONS[place][1],
            "steps": best.step,
            "validation_auc": aucs[place],
            "scale": self._scale,
        }

    def _train(self, train: Features, validation: Features, place: int) -> tuple[Projections, BestStep]:
        """Return projections trained with one regularisation, at their best step."""
        (dropout, weight_decay), config = REGULARISATIONS[place], self.settings.config
        touch, photo = self._tensors(train)
        touch_held_out, photo_held_out = self._tensors(validation)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.settings.seed)  # initial weights and dropout
            owner, generator = torch.from_numpy(train.owner), torch.Generator().manual_seed(self.settings.seed)
            count, draw = int(owner.max()) + 1, row_sampler(owner, generator)
            module = Projections(touch.shape[1], photo.shape[1], config.matcher.embedding_dim, dropout)
            optimizer = torch.optim.AdamW(  # biases and the temperature need not be small
                [
                    {"params": [module.touch.bias, module.photo.bias, module.log_scale], "weight_decay": 0.0},
                    {"params": [module.touch.weight, module.photo.weight], "weight_decay": weight_decay},
                ]
            )
            optimizer.register_step_post_hook(lambda *_: module.clamp_scale())

            def loss(_: int, __: int) -> Tensor:
                distinct = torch.randperm(count, generator=generator)[:OBJECTS_PER_BATCH]
                objects = distinct.repeat(IMAGES_PER_OBJECT)
                touches = module(touch[draw(objects)], module.touch)
                photos = module(photo[draw(objects)], module.photo)
                return contrastive_loss(touches, photos, objects, objects, module.log_scale)

            @torch.inference_mode()
            def validate() -> dict[str, float]:
                module.eval()
                scores = module(touch_held_out, module.touch) @ module(photo_held_out, module.photo).T
                module.train()
                return {"validation_auc": ranking_auc(scores.numpy(), validation.owner)}

            best = train_loop(
                module,
                optimizer,
                Plan(STEPS, LEARNING_RATE, validate_every=VALIDATE_EVERY),
                lambda steps: steps,
                loss,
                title=f"fitting contrastive, regularisation {place + 1} of {len(REGULARISATIONS)}",
                validate=validate,
            )
        return module.eval(), best

    def _tensors(self, features: Features) -> tuple[Tensor, Tensor]:
        return _tensor(self._touch, features.touch), _tensor(self._photo, features.photo)

    @torch.inference_mode()
    def _encode_touch(self, touch: Array) -> Array:
        return np.asarray(self._module(_tensor(self._touch, touch), self._module.touch).numpy())

    @torch.inference_mode()
    def _encode_photo(self, photo: Array) -> Array:
        return np.asarray(self._module(_tensor(self._photo, photo), self._module.photo).numpy())

    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        return self._scale * (touch_encodings @ photo_encodings.T)


def _tensor(standardise: Standardiser, features: NDArray[Any]) -> Tensor:
    return torch.from_numpy(standardise(features)).float()


def row_sampler(owner: Tensor, generator: torch.Generator) -> Callable[[Tensor], Tensor]:
    """Return a function that draws one row of each of its objects (any shape), uniformly.

    `owner` (n,) is the object of each row.
    """
    rows, counts = torch.argsort(owner, stable=True), torch.bincount(owner)
    starts = counts.cumsum(0) - counts

    def draw(objects: Tensor) -> Tensor:
        drawn = torch.rand(objects.shape, generator=generator, dtype=torch.float64)
        return rows[starts[objects] + (drawn * counts[objects]).long()]

    return draw
