"""Settings of a matcher and of its training: frozen dataclasses, read from TOML, unknown keys refused."""

import dataclasses
import math
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from _touch_retrieval.documents import check_fields, typed
from _touch_retrieval.files import read_regular
from retrieval.data.preprocessing import Preprocessing
from retrieval.errors import ConfigError
from retrieval.model.losses import LOGIT_LOSSES, LOSSES
from retrieval.model.towers import TOWER_SEPARATOR, architectures_of, tower_name

if TYPE_CHECKING:
    from retrieval.model.losses.loss import Loss
    from retrieval.model.towers.tower import Tower

Count = Annotated[int, Meta(ge=1)]
Share = Annotated[float, Meta(ge=0, lt=1)]
Weight = Annotated[float, Meta(ge=0)]


# How the touch is fused with the photo; what a checkpoint needs to be rebuilt.


@dataclass(frozen=True)
class MatcherConfig:
    """Architecture of a matcher.

    tower: backbone of both towers (`retrieval.model.towers`). architectures: of those that `transformers` builds, by
    their names, so that a checkpoint needs neither their files nor a network; `Config.using` fills it in. tower_output:
    "classes" (the paper: the 1000-way outputs are fused) or "pooled". fingers: gel images in one touch (training takes
    it from the recording). hidden: width of the fusion head. standardise: centre and scale the features by their
    statistics over the training batches, which lets towers trained from random weights leave the plateau at chance; the
    paper does not. embedding_dim: length of the unit embeddings for candidate search. candidate_width: hidden units of the
    networks that make these embeddings from halves after training (`retrieval.model.candidate_encoder`); 0: they are the
    contrastive ones. candidate_linear: how many of the embedding_dim numbers are linear in the contrastive embedding,
    which needs cosine. cosine: add the scaled cosine of the contrastive embeddings to the match logit; the paper does
    not.
    """

    tower: str = "resnet50"
    tower_output: str = "classes"
    fingers: Count = 2
    hidden: Count = 1024
    dropout: Share = 0.5
    standardise: bool = False
    embedding_dim: Count = 128
    candidate_width: Annotated[int, Meta(ge=0)] = 0
    candidate_linear: int = 0
    cosine: bool = False
    architectures: Mapping[str, Any] = field(default_factory=dict)

    @property
    def partial_width(self) -> int:
        """Numbers in a half: the share of the head's first layer, and the scaled embedding where its cosine counts."""
        return self.hidden + (self.embedding_dim if self.cosine else 0)

    def __post_init__(self) -> None:
        check_fields(self, "matcher", ConfigError)
        most = self.embedding_dim - 1 if self.cosine else 0
        _require(
            0 <= self.candidate_linear <= most,
            f"matcher.candidate_linear must be from 0 to {most} (below embedding_dim, and 0 without cosine), got "
            f"{self.candidate_linear}",
        )


@dataclass(frozen=True)
class TrainingConfig:
    """How a matcher is trained.

    init: "random", "imagenet", "shipped" or the path of a state dict. init_touch, init_photo: the same for one tower
    alone, where they are not empty (`retrieval.training.relief` makes such weights); of towers side by side the part
    "init" is what init says. photos, touches: folders of labelled pictures
    whose objects are paired by their labels and trained on beside the recording's (`retrieval.data.labelled_pictures`);
    both or neither. iterations: optimiser steps. touches_per_batch times (positives_per_touch + negatives_per_touch)
    pairs make a batch. weights: of the losses that are added to the match loss (`retrieval.model.losses.LOSSES`), in
    files `contrastive_weight` and so on; 0 for each is exactly the paper's loss, and without one on embeddings these
    stay untrained. shuffle_fingers: feed the fingers of a touch in a random order, as gripping the other way
    round would; not in the paper. negatives: "dataset" draws a touch's from all photos of other objects, as in the
    paper; "batch" from the photos that stand in the batch anyway, half as many to encode (`PairSampler`); "auto" is
    "batch" where towers are trained. freeze_batch_norm: keep the batch statistics of the initial weights.
    freeze_towers: train only what comes after the towers; every image is then encoded once for the whole training.
    distil_steps: steps of teaching the candidate_encoder after training, where the matcher has one (`retrieval.training.distil`).
    validation_fraction, test_fraction: shares of the objects.

    The loader has three settings that no result depends on, so that checkpoints and caches leave them out. workers:
    threads that decode images, "auto" for one on each core. prefetch: batches that are loaded ahead of the step.
    pinned_memory: copy batches to a GPU from page-locked memory while it computes.
    """

    init: str = "imagenet"
    init_touch: str = ""
    init_photo: str = ""
    photos: str = ""
    touches: str = ""
    iterations: Count = 26_000
    touches_per_batch: Count = 6
    positives_per_touch: Count = 4
    negatives_per_touch: Count = 4
    learning_rate: Annotated[float, Meta(gt=0)] = 1e-4
    schedule: str = "constant"
    weights: Mapping[str, float] = field(default_factory=dict)
    shuffle_fingers: bool = False
    negatives: str = "auto"
    freeze_batch_norm: bool = False
    freeze_towers: bool = False
    distil_steps: Count = 600
    validation_fraction: Share = 0.1
    test_fraction: Share = 0.184
    validate_every: Count = 500
    precision: str = "auto"
    seed: Annotated[int, Meta(ge=0, lt=2**32)] = 0
    workers: Count | str = field(default="auto", compare=False)
    prefetch: Count = field(default=2, compare=False)
    pinned_memory: bool = field(default=True, compare=False)

    def __post_init__(self) -> None:
        own = {name: self.weights[name] for name in sorted(self.weights) if name not in LOSSES}
        weights = {name: self.weights.get(name, 0.0) for name in LOSSES} | own
        for name, weight in weights.items():
            weights[name] = typed(weight, Weight, f"training.{name}{WEIGHT_SUFFIX}", error=ConfigError)
        object.__setattr__(self, "weights", weights)
        check_fields(self, "training", ConfigError)
        auto = not isinstance(self.workers, str) or self.workers == "auto"
        _require(auto, f'training.workers must be "auto" or a whole number >= 1, got {self.workers!r}')
        for name, known in (("schedule", SCHEDULES), ("negatives", NEGATIVES), ("precision", PRECISIONS)):
            value = getattr(self, name)
            _require(value in known, f"training.{name} must be one of {', '.join(known)}, got {value!r}")
        _require(
            bool(self.photos) == bool(self.touches),
            f"labelled photos are paired with labelled touches; got photos {self.photos!r}, touches {self.touches!r}",
        )
        held_out = (self.validation_fraction, self.test_fraction)
        _require(
            sum(held_out) < 1, f"validation_fraction and test_fraction must leave objects to train on; got {held_out}"
        )

    def tower_init(self, of_one: str) -> str:
        """First weights of one tower, from `init_touch` or `init_photo`."""
        return TOWER_SEPARATOR.join(
            self.init if part == "init" else part for part in (of_one or "init").split(TOWER_SEPARATOR)
        )

    @property
    def trains_embeddings(self) -> bool:
        """Whether the contrastive projections learn anything."""
        return any(weight > 0 for name, weight in self.weights.items() if name not in LOGIT_LOSSES)

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary, as in a TOML file, without the settings of the loader: each weight is a setting of its own,
        `<loss>_weight`.
        """
        table: dict[str, Any] = {}
        for name, value in dataclasses.asdict(self).items():
            if name in LOADER_SETTINGS:
                continue
            table |= (
                {f"{loss}{WEIGHT_SUFFIX}": weight for loss, weight in value.items()}
                if name == "weights"
                else {name: value}
            )
        return table

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> "TrainingConfig":
        """Inverse of `to_dict`; a setting left out keeps its default. Raises ConfigError."""
        weights = {
            name.removesuffix(WEIGHT_SUFFIX): value for name, value in table.items() if name.endswith(WEIGHT_SUFFIX)
        }
        rest = {name: value for name, value in table.items() if not name.endswith(WEIGHT_SUFFIX)}
        known = {*cls().to_dict(), *LOADER_SETTINGS}
        if unknown := [name for name in rest if name not in known]:
            raise ConfigError(f"training has no setting {unknown[0]!r}; it knows {', '.join(sorted(known))}")
        return cls(**rest, weights=weights)

    def with_iterations(self, iterations: int) -> "TrainingConfig":
        """The same with so many optimiser steps, and at most as many to teach the candidate_encoder."""
        return dataclasses.replace(self, iterations=iterations, distil_steps=min(self.distil_steps, iterations))


LOADER_SETTINGS = ("workers", "prefetch", "pinned_memory")
"""Settings of the loader, which decide no result."""
WEIGHT_SUFFIX = "_weight"
"""What ends the setting of a loss's weight."""
SCHEDULES: dict[str, Callable[[int, int], float]] = {
    "constant": lambda step, steps: 1.0,
    "cosine": lambda step, steps: 0.5 * (1 + math.cos(math.pi * step / steps)),
    "halving": lambda step, steps: 0.5 ** (4 * step // steps),
}
"""Name -> the share of the learning rate that a step, from 0, of so many takes; halving: after each quarter."""
NEGATIVES = ("auto", "batch", "dataset")
PRECISIONS = ("auto", "float32", "bfloat16")


@dataclass(frozen=True)
class Config:
    """Everything that decides what a training run makes, but the recording.

    >>> retrieval.load_config("paper").matcher.tower
    'resnet50'
    """

    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    preprocessing: Preprocessing = field(default_factory=Preprocessing)

    @property
    def has_embeddings(self) -> bool:
        """Whether embeddings are trained, so that candidates can be searched by them."""
        return self.matcher.candidate_width > 0 or self.training.trains_embeddings

    def without_candidate_encoder(self) -> "Config":
        """The same with no candidate_encoder to be taught."""
        return dataclasses.replace(
            self, matcher=dataclasses.replace(self.matcher, candidate_width=0, candidate_linear=0)
        )

    def with_candidate_encoder_of(self, other: "Config") -> "Config":
        """The same with a candidate_encoder as `other` has it, as far as this logit has a cosine to be linear in."""
        wanted = other.matcher
        linear = min(wanted.candidate_linear, self.matcher.embedding_dim - 1) if self.matcher.cosine else 0
        matcher = dataclasses.replace(self.matcher, candidate_width=wanted.candidate_width, candidate_linear=linear)
        return dataclasses.replace(self, matcher=matcher)

    def using(
        self,
        *,
        tower: "str | type[Tower] | None" = None,
        losses: "Mapping[str, float] | Mapping[str | type[Loss], float] | None" = None,
    ) -> "Config":
        """Return the configuration with another tower, or with other losses beside the match loss.

        Args:
            tower: A name, "module:Class", or a class.
            losses: Of each, a name, "module:Class", or a class, with its weight; those left out weigh nothing.

        Raises:
            ConfigError: For an unknown name.

        >>> config = retrieval.load_config("small").using(tower="resnet18", losses={"sigmoid": 0.5})
        >>> config.matcher.tower, config.training.weights["sigmoid"]
        ('resnet18', 0.5)
        """
        made = self
        if tower is not None:
            name = tower_name(tower)
            matcher = dataclasses.replace(made.matcher, tower=name, architectures=architectures_of(name))
            made = dataclasses.replace(made, matcher=matcher)
        if losses is not None:
            weights = {LOSSES.name_of(loss): weight for loss, weight in losses.items()}
            made = dataclasses.replace(made, training=dataclasses.replace(made.training, weights=weights))
        return made

    def without_paths(self) -> dict[str, Any]:
        """As `to_dict`, of files and folders the names alone: where they lay on this machine concerns nobody."""
        tables = self.to_dict()
        for name in ("init", "init_photo", "init_touch", "photos", "touches"):
            parts = tables["training"][name].split(TOWER_SEPARATOR)
            tables["training"][name] = TOWER_SEPARATOR.join(Path(part).name for part in parts)
        matcher = tables["matcher"]
        for part in matcher["architectures"]:
            family, _, model = part.partition(":")
            if Path(model).is_absolute():
                matcher["tower"] = matcher["tower"].replace(part, f"{family}:{Path(model).name}")
        del matcher["architectures"]
        return tables

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary, as in a TOML file."""
        return {
            "matcher": dataclasses.asdict(self.matcher),
            "training": self.training.to_dict(),
            "preprocessing": self.preprocessing.to_dict(),
        }

    @classmethod
    def from_dict(cls, tables: Mapping[str, Any]) -> "Config":
        """Build from nested tables; a key left out keeps its default, an unknown one raises ConfigError."""
        training = tables.get("training") if isinstance(tables, Mapping) else None
        if isinstance(training, Mapping):  # whose weights are settings of their own in a file
            tables = {**tables, "training": TrainingConfig.from_dict(training)}
        return typed(tables, cls, error=ConfigError)


def load_config(name_or_path: str) -> Config:
    """Read a named preset (`paper`, `small`, ...) or a TOML file, and import what it names. Raises ConfigError.

    >>> retrieval.load_config("small").training.weights["contrastive"] > 0
    True
    >>> retrieval.load_config("huge")
    Traceback (most recent call last):
    retrieval.errors.ConfigError: --config must be one of adapt, ...
    """
    file = Path(name_or_path)
    if name_or_path in preset_names():
        file = Path(str(resources.files("retrieval") / "configs" / f"{name_or_path}.toml"))
    elif os.path.isdir(file) or not os.path.exists(file):  # False, and no error, for a name that no disk takes
        raise ConfigError(
            f"--config must be one of {', '.join(preset_names())} or a TOML file; there is no {name_or_path!r}"
        )
    try:
        config = Config.from_dict(tomllib.loads(read_regular(file).decode()))
    except OSError as error:
        raise ConfigError(f"{name_or_path} cannot be read: {error.strerror}") from error
    except ValueError as error:  # what TOML or UTF-8 forbids
        raise ConfigError(f"{name_or_path} is not valid TOML: {error}") from error
    return config.using(tower=config.matcher.tower, losses=dict(config.training.weights))


def named_config(config: Config | str, name: str | None = None) -> tuple[Config, str]:
    """Return a configuration, given as such or as `load_config` takes it, and what it is called."""
    if isinstance(config, Config):
        return config, name or "own"
    return load_config(config), name or Path(config).stem


def preset_names() -> list[str]:
    """Names of the presets that come with the package."""
    files = (resources.files("retrieval") / "configs").iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ConfigError(message)
