"""Settings of a matcher and of its training: frozen dataclasses, read from TOML; unknown keys are errors."""

import dataclasses
import math
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from _touch_retrieval.documents import Count, NonNegative, Positive, Seed, check_fields, typed
from _touch_retrieval.files import read_regular
from _touch_retrieval.text import decode_text
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import ConfigError
from retrieval.model.losses import LOGIT_LOSSES, LOSSES
from retrieval.model.towers import TOWER_SEPARATOR, tower_name

FractionBelowOne = Annotated[float, Meta(ge=0, lt=1)]


# Settings from which a checkpoint rebuilds its matcher.


@dataclass(frozen=True)
class MatcherConfig:
    """Architecture of a matcher.

    Attributes:
        tower: Backbone of both towers (`retrieval.model.towers`).
        tower_output: "classes" (the paper: the 1000-way outputs are fused), "pooled" or "stages".
        fingers: Gel images in one touch. Training takes the number from the recording.
        hidden: Width of the fusion head.
        dropout: Dropout probability in the fusion head.
        standardise: Centre and scale the features by their statistics over the training batches. Not in the paper.
        embedding_dim: Length of the unit embeddings for candidate search.
        candidate_width: Hidden units of the candidate encoder (`retrieval.model.candidate_encoder`); 0 for none.
        candidate_linear: Components of its embeddings that are linear in the contrastive embedding; requires `cosine`.
        projection_hidden: Hidden units of the projections to the contrastive embeddings. 0: the projections are linear.
        cell_dim: Length of a cell's vector in the late interaction (`retrieval.model.late_interaction`), which needs
            tower_output "stages". 0: no late interaction, as in the paper.
        touch_cells: Cells along each side of a gel image.
        photo_cells: Cells along each side of the last view of a photo.
        cosine: Add the scaled cosine of the contrastive embeddings to the match logit. Not in the paper.
        photo_tower: Backbone of the photo tower, if not empty; `tower` is then that of the touch tower.
    """

    tower: str = "resnet50"
    tower_output: Literal["classes", "pooled", "stages"] = "classes"
    fingers: Count = 2
    hidden: Count = 1024
    dropout: FractionBelowOne = 0.5
    standardise: bool = False
    embedding_dim: Count = 128
    candidate_width: Annotated[int, Meta(ge=0)] = 0
    candidate_linear: Annotated[int, Meta(ge=0)] = 0
    projection_hidden: Annotated[int, Meta(ge=0)] = 0
    cell_dim: Annotated[int, Meta(ge=0)] = 0
    touch_cells: Count = 4
    photo_cells: Count = 10
    cosine: bool = False
    photo_tower: str = ""

    @property
    def pooled_width(self) -> int:
        """Width of a partial activation without cells: the head's term, then the scaled embedding with `cosine`."""
        return self.hidden + (self.embedding_dim if self.cosine else 0)

    @property
    def touch_partial_width(self) -> int:
        """Width of a touch's partial activation."""
        return self.pooled_width + self.fingers * self.touch_cells**2 * self.cell_dim

    @property
    def partial_width(self) -> int:
        """Width of a photo's partial activation."""
        return self.pooled_width + self.photo_cells**2 * self.cell_dim

    def __post_init__(self) -> None:
        check_fields(self, "matcher", ConfigError)
        limit = self.embedding_dim - 1 if self.cosine else 0
        if self.candidate_linear > limit:
            raise ConfigError(
                f"matcher.candidate_linear must be from 0 to {limit} (below embedding_dim, and 0 without cosine), got "
                f"{self.candidate_linear}"
            )
        if self.cell_dim and self.tower_output != "stages":
            raise ConfigError(f'matcher.cell_dim above 0 needs tower_output = "stages", got {self.tower_output!r}')


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of a training run.

    With every weight 0 the loss is exactly the paper's. Without a loss on embeddings these stay untrained. No result
    depends on `workers`, so checkpoints and caches omit it.

    Attributes:
        init: Initial weights of the towers: "random", "imagenet", "shipped", "gel" or the path of a state dict.
        init_touch: Initial weights of the touch tower, if not empty. The part "init" stands for the value of `init`.
        init_photo: The same for the photo tower.
        start: Checkpoint whose towers and head the training continues from, if not empty, instead of initial weights.
        iterations: Optimiser steps.
        touches_per_batch: Touches in a batch. Each forms pairs with its positives and negatives.
        positives_per_touch: Photos of the touch's object in a batch.
        negatives_per_touch: Photos of other objects in a batch.
        learning_rate: Learning rate of the optimiser.
        tower_rate: Ratio of the towers' learning rate to that of the other layers.
        schedule: Name of a learning rate schedule in `SCHEDULES`.
        weights: Weights of the losses that are added to the match loss (`retrieval.model.losses.LOSSES`); in files
            `contrastive_weight` and so on.
        shuffle_fingers: Permute the fingers of a touch randomly, like a grip from the other side. Not in the paper.
        negatives: "dataset" draws the negatives of a touch from all photos of other objects, as in the paper, "batch"
            from the photos of the batch, so half as many are encoded. "auto" is "batch" if towers are trained.
        freeze_batch_norm: Keep the batch statistics of the initial weights.
        freeze_towers: Train only the layers after the towers. Every image is then encoded once per training run.
        freeze_stem: Keep the first layers of the towers (`Tower.stem_layers`) frozen if the towers are trained.
        augment: Change the images of each step at random (`retrieval.training.augmentation`), if towers are trained.
        distil_steps: Steps that distil the candidate encoder after training (`retrieval.training.distil`).
        validation_fraction: Fraction of the objects that are validation objects.
        test_fraction: Fraction of the objects that are test objects.
        validate_every: Steps between two validations.
        precision: "float32", "bfloat16" or "auto" (`retrieval.model.encode.autocast`).
        seed: Seed of all random choices.
        workers: Processes that decode images, if towers are trained; "auto": one per core with a GPU, none on a CPU.
    """

    init: str = "imagenet"
    init_touch: str = ""
    init_photo: str = ""
    start: str = ""
    iterations: Count = 26_000
    touches_per_batch: Count = 6
    positives_per_touch: Count = 4
    negatives_per_touch: Count = 4
    learning_rate: Positive = 1e-4
    tower_rate: Positive = 1.0
    schedule: Literal["constant", "cosine", "warmup", "halving"] = "constant"
    weights: Mapping[str, float] = field(default_factory=dict)
    shuffle_fingers: bool = False
    negatives: Literal["auto", "batch", "dataset"] = "auto"
    freeze_batch_norm: bool = False
    freeze_towers: bool = False
    freeze_stem: bool = False
    augment: bool = False
    distil_steps: Count = 600
    validation_fraction: FractionBelowOne = 0.1
    test_fraction: FractionBelowOne = 0.184
    validate_every: Count = 500
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    seed: Seed = 0
    workers: Annotated[int, Meta(ge=0)] | Literal["auto"] = field(default="auto", compare=False)

    def __post_init__(self) -> None:
        weights = {
            name: typed(weight, NonNegative, f"training.{name}{WEIGHT_SUFFIX}", error=ConfigError)
            for name, weight in (dict.fromkeys(LOSSES, 0.0) | dict(sorted(self.weights.items()))).items()
        }
        object.__setattr__(self, "weights", weights)
        check_fields(self, "training", ConfigError)
        held_out = (self.validation_fraction, self.test_fraction)
        if sum(held_out) >= 1:
            raise ConfigError(f"validation_fraction and test_fraction must leave objects to train on; got {held_out}")

    def tower_init(self, of_one: str) -> str:
        """Return the initial weights of one tower, given its `init_touch` or `init_photo`."""
        return TOWER_SEPARATOR.join(
            self.init if part == "init" else part for part in (of_one or "init").split(TOWER_SEPARATOR)
        )

    @property
    def trains_embeddings(self) -> bool:
        """Whether a loss trains the contrastive projections."""
        return any(weight > 0 for name, weight in self.weights.items() if name not in LOGIT_LOSSES)

    def to_dict(self) -> dict[str, Any]:
        """Return a plain dictionary, as in a TOML file, without `workers`; each weight is a setting `<loss>_weight`."""
        table: dict[str, Any] = {}
        for name, value in dataclasses.asdict(self).items():
            if name == "weights":
                table |= {f"{loss}{WEIGHT_SUFFIX}": weight for loss, weight in value.items()}
            elif name != "workers":
                table[name] = value
        return table

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> "TrainingConfig":
        """Inverse of `to_dict`; a missing setting keeps its default. Raises ConfigError."""
        weights = {
            name.removesuffix(WEIGHT_SUFFIX): value for name, value in table.items() if name.endswith(WEIGHT_SUFFIX)
        }
        rest = {name: value for name, value in table.items() if not name.endswith(WEIGHT_SUFFIX)}
        known = {*cls().to_dict(), "workers"}
        if unknown := [name for name in rest if name not in known]:
            raise ConfigError(f"training has no setting {unknown[0]!r}; known settings: {', '.join(sorted(known))}")
        return cls(**rest, weights=weights)

    def with_iterations(self, iterations: int) -> "TrainingConfig":
        """Return a copy with `iterations` optimiser steps, and at most as many distillation steps."""
        return dataclasses.replace(self, iterations=iterations, distil_steps=min(self.distil_steps, iterations))

    def with_given_weights(self, **settings: Any) -> "TrainingConfig":
        """Return a copy that names no initial weights, because they are given, or are random; with other settings."""
        return dataclasses.replace(self, init="random", init_touch="", init_photo="", start="", **settings)


WEIGHT_SUFFIX = "_weight"
"""Suffix of the settings that are weights of losses."""
SCHEDULES: dict[str, Callable[[int, int], float]] = {
    "constant": lambda step, steps: 1.0,
    "cosine": lambda step, steps: 0.5 * (1 + math.cos(math.pi * step / steps)),
    "warmup": lambda step, steps: min(1.0, 20 * (step + 1) / steps) * 0.5 * (1 + math.cos(math.pi * step / steps)),
    "halving": lambda step, steps: 0.5 ** (4 * step // steps),
}
"""Factor of the learning rate. "warmup" is "cosine" with a linear rise over the first twentieth of the steps."""


@dataclass(frozen=True)
class Config:
    """All inputs of a training run except the recording.

    >>> retrieval.load_config("paper").matcher.tower
    'resnet50'
    """

    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    preprocessing: Preprocessing = field(default_factory=Preprocessing)

    @property
    def has_embeddings(self) -> bool:
        """Whether embeddings are trained, so that candidate search can use them."""
        return self.matcher.candidate_width > 0 or self.training.trains_embeddings

    def without_candidate_encoder(self) -> "Config":
        """Return a copy without a candidate encoder."""
        return dataclasses.replace(
            self, matcher=dataclasses.replace(self.matcher, candidate_width=0, candidate_linear=0)
        )

    def with_candidate_encoder_of(self, other: "Config") -> "Config":
        """Return a copy with the candidate encoder of `other`, but no linear components without a cosine."""
        source = other.matcher
        linear = min(source.candidate_linear, self.matcher.embedding_dim - 1) if self.matcher.cosine else 0
        matcher = dataclasses.replace(self.matcher, candidate_width=source.candidate_width, candidate_linear=linear)
        return dataclasses.replace(self, matcher=matcher)

    def using(
        self,
        *,
        tower: str | type | None = None,
        losses: Mapping[str, float] | Mapping[str | type, float] | None = None,
    ) -> "Config":
        """Return the configuration with another tower, or with other losses in addition to the match loss.

        Args:
            tower: A name, "module:Class", or a class.
            losses: Weight by loss. A loss is a name, "module:Class", or a class; losses that are not listed weigh 0.

        Raises:
            ConfigError: A name is unknown.

        >>> config = retrieval.load_config("mobilenet").using(tower="resnet18", losses={"listwise": 0.5})
        >>> config.matcher.tower, config.training.weights["listwise"]
        ('resnet18', 0.5)
        """
        config = self
        if tower is not None:
            name = tower_name(tower)
            photo = config.matcher.photo_tower if name == config.matcher.tower else ""
            matcher = dataclasses.replace(config.matcher, tower=name, photo_tower=photo)
            config = dataclasses.replace(config, matcher=matcher)
        if losses is not None:
            weights = {LOSSES.name_of(loss): weight for loss, weight in losses.items()}
            config = dataclasses.replace(config, training=dataclasses.replace(config.training, weights=weights))
        return config

    def without_paths(self) -> dict[str, Any]:
        """Return `to_dict` with the names of files and folders in place of their paths on this machine."""
        tables = self.to_dict()
        training = tables["training"]
        for name in ("init", "init_photo", "init_touch", "start"):
            training[name] = TOWER_SEPARATOR.join(Path(part).name for part in training[name].split(TOWER_SEPARATOR))
        return tables

    def to_dict(self) -> dict[str, Any]:
        """Return a plain nested dictionary, as in a TOML file."""
        return {
            "matcher": dataclasses.asdict(self.matcher),
            "training": self.training.to_dict(),
            "preprocessing": self.preprocessing.to_dict(),
        }

    @classmethod
    def from_dict(cls, tables: Mapping[str, Any]) -> "Config":
        """Build from nested tables; a missing key keeps its default, an unknown one raises ConfigError."""
        training = tables.get("training") if isinstance(tables, Mapping) else None
        if isinstance(training, Mapping):  # in a file, each loss weight is a setting of its own
            tables = {**tables, "training": TrainingConfig.from_dict(training)}
        return typed(tables, cls, error=ConfigError)


def load_config(name_or_path: str) -> Config:
    """Read a named preset (`paper`, `mobilenet`, ...) or a TOML file, and import its modules. Raises ConfigError.

    >>> retrieval.load_config("mobilenet").training.weights["contrastive"] > 0
    True
    >>> retrieval.load_config("huge")
    Traceback (most recent call last):
    retrieval.errors.ConfigError: --config must be one of linear, ...
    """
    file = Path(name_or_path)
    if name_or_path in preset_names():
        file = Path(str(resources.files("retrieval") / "configs" / f"{name_or_path}.toml"))
    elif os.path.isdir(file) or not os.path.exists(file):  # False, without an error, for an invalid file name
        raise ConfigError(
            f"--config must be one of {', '.join(preset_names())} or a TOML file; there is no {name_or_path!r}"
        )
    try:
        config = Config.from_dict(tomllib.loads(decode_text(read_regular(file))))
    except OSError as error:
        raise ConfigError(f"{name_or_path} cannot be read: {error.strerror}") from error
    except ValueError as error:  # invalid TOML or UTF-8
        raise ConfigError(f"{name_or_path} is not valid TOML: {error}") from error
    return config.using(tower=config.matcher.tower, losses=dict(config.training.weights))


def named_config(config: Config | str, name: str | None = None) -> tuple[Config, str]:
    """Return a configuration, given itself or as in `load_config`, and its name."""
    if isinstance(config, Config):
        return config, name or "own"
    return load_config(config), name or Path(config).stem


def preset_names() -> list[str]:
    """Return the names of the presets in the package."""
    files = (resources.files("retrieval") / "configs").iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))
