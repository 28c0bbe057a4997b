"""Two projections into one metric space, trained by a contrastive loss on fixed tower features."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional

from retrieval.console.progress import Bar
from retrieval.methods.method import Array, Method
from retrieval.methods.object_sampler import ObjectSampler, seeded_generator
from retrieval.methods.selection import Validator
from retrieval.methods.standardise import Standardiser
from retrieval.model.losses.contrastive import LOG_SCALE_INIT, LOG_SCALE_MAX, contrastive_loss
from retrieval.model.losses.sigmoid import SIGMOID_BIAS_INIT, SIGMOID_LOG_SCALE_INIT, sigmoid_loss
from retrieval.training.fit import BestStep, Plan, fit_best

if TYPE_CHECKING:
    from retrieval.training.features import Features

MAX_STEPS, VALIDATE_EVERY = 800, 40
LEARNING_RATE = 1e-3
OBJECTS_PER_BATCH, IMAGES_PER_OBJECT = 64, 2
"""A batch contains each object at most once, with IMAGES_PER_OBJECT of its touches and of its photos."""
REGULARISATIONS = ((0.5, 0.0), (0.8, 0.0), (0.9, 0.0), (0.8, 1.0))
"""Pairs of feature dropout and weight decay to choose from."""


class Projections(nn.Module):
    """Linear maps from standardised features to unit embeddings, as in the matcher, with dropout before them."""

    log_scale_init, bias_init = LOG_SCALE_INIT, 0.0

    def __init__(self, touch_features: int, photo_features: int, dim: int, dropout: float) -> None:
        super().__init__()
        self.dropout = nn.Dropout(dropout)
        self.touch, self.photo = nn.Linear(touch_features, dim), nn.Linear(photo_features, dim)
        self.log_scale = nn.Parameter(torch.tensor(self.log_scale_init))
        self.bias = nn.Parameter(torch.tensor(self.bias_init))

    def forward(self, features: Tensor, projection: nn.Linear) -> Tensor:
        """Return unit embeddings (B, dim) of features (B, F)."""
        embedding: Tensor = projection(self.dropout(features))
        return functional.normalize(embedding, dim=-1, eps=1e-6)

    def loss(self, touch: Tensor, photo: Tensor, touch_objects: Tensor, photo_objects: Tensor) -> Tensor:
        """Return the loss (scalar) of a batch of embeddings. InfoNCE does not depend on a bias, which stays 0."""
        return contrastive_loss(touch, photo, touch_objects, photo_objects, self.log_scale)

    @torch.no_grad()
    def clamp_scale(self) -> None:
        """Clamp the scale to 1..100. The parameter is clamped, so that its gradient can reduce it again."""
        self.log_scale.clamp_(0.0, LOG_SCALE_MAX)

    @torch.no_grad()
    def logit_map(self) -> tuple[float, float]:
        """Return scale and bias that map cosines to logits."""
        return self.log_scale.exp().item(), self.bias.item()


class SigmoidProjections(Projections):
    """Projections with the sigmoid loss and its learned bias."""

    log_scale_init, bias_init = SIGMOID_LOG_SCALE_INIT, SIGMOID_BIAS_INIT

    def loss(self, touch: Tensor, photo: Tensor, touch_objects: Tensor, photo_objects: Tensor) -> Tensor:
        """Return the loss (scalar) of a batch of embeddings."""
        return sigmoid_loss(touch, photo, touch_objects, photo_objects, self.log_scale, self.bias)


class ContrastiveEmbedding(Method):
    """Scaled cosine of InfoNCE embeddings; regularisation and steps are chosen by ranking on validation objects."""

    name = "contrastive"
    projections: type[Projections] = Projections

    def _fit(self, train: "Features", validation: "Features") -> None:
        self._touch, self._photo = Standardiser.fit(train.touch), Standardiser.fit(train.photo)
        validator = Validator.of(validation)
        steps = min(self.settings.config.training.iterations, MAX_STEPS)
        with Bar(f"fit {self.name}", steps * len(REGULARISATIONS), "steps", quiet=self.settings.quiet) as bar:
            fits = [self._train(train, validator, *cell, steps, bar) for cell in REGULARISATIONS]
        aucs = [best.value for _, best in fits]
        place = aucs.index(max(aucs))
        self._module, best = fits[place]
        scale, bias = self._module.logit_map()
        self.best_params = {
            "dropout": REGULARISATIONS[place][0],
            "weight_decay": REGULARISATIONS[place][1],
            "steps": best.step,
            "validation_auc": best.value,
            "scale": scale,
            "bias": bias,
        }

    def _train(
        self, train: "Features", validator: Validator, dropout: float, weight_decay: float, steps: int, bar: Bar
    ) -> tuple[Projections, BestStep]:
        """Return projections trained with one regularisation, at their best step."""
        with seeded_generator(self.settings.seed) as generator:
            dim = self.settings.config.matcher.embedding_dim
            module = self.projections(len(self._touch.columns), len(self._photo.columns), dim, dropout)
            plan = Plan(steps, LEARNING_RATE, validate_every=VALIDATE_EVERY)
            loss, validation_auc = (
                self._training_loss(module, train, generator),
                self._validation_auc(module, validator),
            )
            best = fit_best(
                module,
                plan,
                loss,
                validation_auc,
                bar=bar,
                weight_decay=weight_decay,
                after_step=lambda _: module.clamp_scale(),
            )
        return module, best

    def _training_loss(
        self, module: Projections, train: "Features", generator: torch.Generator
    ) -> Callable[[int], Tensor]:
        touch, photo = self._touch.tensor(train.touch), self._photo.tensor(train.photo)
        draws = ObjectSampler(torch.from_numpy(train.owner), generator)

        def loss(_: int) -> Tensor:
            objects = draws.distinct_objects(OBJECTS_PER_BATCH).repeat(IMAGES_PER_OBJECT)
            touches = module(touch[draws.rows(objects)], module.touch)
            photos = module(photo[draws.rows(objects)], module.photo)
            return module.loss(touches, photos, objects, objects)

        return loss

    def _validation_auc(self, module: Projections, validator: Validator) -> Callable[[], float]:
        touch = self._touch.tensor(validator.features.touch)
        photo = self._photo.tensor(validator.features.photo)
        return lambda: validator.touch_auc((module(touch, module.touch) @ module(photo, module.photo).T).numpy())

    @torch.inference_mode()
    def _encode_touch(self, touch: Array) -> Array:
        embeddings: Array = self._module(self._touch.tensor(touch), self._module.touch).numpy()
        return embeddings

    @torch.inference_mode()
    def _encode_photo(self, photo: Array) -> Array:
        embeddings: Array = self._module(self._photo.tensor(photo), self._module.photo).numpy()
        return embeddings

    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        scale, bias = self._module.logit_map()
        return scale * (touch_encodings @ photo_encodings.T) + bias


class SigmoidEmbedding(ContrastiveEmbedding):
    """Contrastive embeddings with the sigmoid loss: the scores are log-odds of a match."""

    name = "contrastive_sigmoid"
    projections = SigmoidProjections
