"""The base class of recipes, and the recipes of the package."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from retrieval.data.camera import PhotoCamera
from retrieval.data.dataset import DataLicence, Grasp, Split, make_split, recording_licence
from retrieval.model.card import checkpoint_licences
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config
from retrieval.model.encode import default_device
from retrieval.model.fusion import Matcher
from retrieval.training.batches import FrozenFeatures
from retrieval.training.features import Features, features_by_image
from retrieval.training.initial_weights import build_matcher, training_licences
from retrieval.training.linear import available_config, fit_linear
from retrieval.training.loop import OnStep
from retrieval.training.selection import held_out_folds
from retrieval.training.trainer import Trainer

DISTIL_STEPS = 600
"""Steps of the candidate encoder of a trained head."""
VALIDATION_FRACTION = 0.15
"""Fraction of the fitted objects that choose the step of a trained head."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What a recipe is fitted to.

    Attributes:
        grasps: The grasps of the recording.
        camera: The camera of their photos.
        fingers: Gel images of a touch.
        start: The start model.
        init: Weights of the published tower: "imagenet", a file, or "random" for none.
        kind_of: Class of each object, if the recording names it.
        linked: Groups of objects that stay together, such as those of one sequence.
        folder: Folder of unfinished trainings, which continue there.
        on_step: Told of the steps of the final fit (`retrieval.train`).
    """

    grasps: Sequence[Grasp]
    camera: PhotoCamera
    fingers: int
    start: Checkpoint
    init: str
    kind_of: Mapping[str, str]
    linked: Sequence[Sequence[str]]
    folder: Path
    on_step: OnStep | None = None


class Recipe(ABC):
    """A way to fit a matcher to features of frozen towers.

    Attributes:
        label: What the recipe does, for people.
        uses_start: Whether it uses the start model, which must then not know the objects that it is tested with.
        config: Configuration of the towers.
        matcher: A matcher with the towers whose features `fit` takes.

    A recipe of your own may change another one, here the training of the start model's head. `retrieval.train` takes it
    as `recipe`:

    >>> from retrieval.training.recipes.recipe import ContinuedHead
    >>> class Brief(ContinuedHead):
    ...     label = "start model's head, a few steps"
    ...     steps = 2
    >>> issubclass(Brief, retrieval.Recipe)
    True
    """

    label: ClassVar[str]
    uses_start: ClassVar[bool] = True
    config: Config
    matcher: Matcher

    def __init__(self, problem: Problem) -> None:
        self.problem, self.config, self.matcher = problem, problem.start.config, problem.start.matcher

    @classmethod
    def obstacle(cls, problem: Problem) -> str:
        """Return why the recipe cannot be fitted; empty if it can."""
        fingers = problem.start.config.matcher.fingers
        if cls.uses_start and fingers != problem.fingers:
            return f"the start model takes {fingers} gel image(s) of a touch, and the recording has {problem.fingers}"
        return ""

    def licences(self, recording: Path) -> list[DataLicence]:
        """Return the licences of all data that a model of this recipe is made from."""
        return [*checkpoint_licences(self.problem.start), recording_licence(recording)]

    @abstractmethod
    def fit(self, features: Features, name: str, *, is_final: bool = False) -> Checkpoint:
        """Return a model that is fitted to these features; nothing is written.

        Args:
            features: Features of some of the grasps; nothing may be taken from the other objects.
            name: Name of the fit, for files and progress.
            is_final: Whether the model is the result, which also needs a candidate encoder if its head has one.
        """


class Start(Recipe):
    """The start model: nothing is fitted."""

    label = "start model as it is"

    def fit(self, features: Features, name: str, *, is_final: bool = False) -> Checkpoint:
        """Return the start model, with a matcher of its own, since a new gel check changes it."""
        return dataclasses.replace(self.problem.start, matcher=deepcopy(self.problem.start.matcher))


class Linear(Recipe):
    """Canonical correlations of the features of published towers."""

    label = "linear fit to published towers"
    uses_start = False

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        self.config = available_config(problem.fingers, problem.init)
        self.matcher = build_matcher(self.config).eval()

    def licences(self, recording: Path) -> list[DataLicence]:
        """Return the licences of the towers' data and of the recording."""
        return training_licences(recording, self.config.training)

    def fit(self, features: Features, name: str, *, is_final: bool = False) -> Checkpoint:
        """Return the fitted model."""
        folds = held_out_folds(features, self.problem.kind_of, self.problem.linked)
        config, matcher = fit_linear(features, self.config, folds)
        matcher.touch_tower, matcher.photo_tower = self.matcher.touch_tower, self.matcher.photo_tower
        split = Split(0, tuple(sorted(set(features.object_ids))), (), ())
        return Checkpoint(Path(name), "", config, {"step": 0}, matcher=matcher, split=split)


class ContinuedHead(Recipe):
    """The head of the start model, trained further on its frozen towers with a small learning rate."""

    label = "start model's head, trained further"
    steps: ClassVar[int] = 150
    touches_per_batch: ClassVar[int] = 64
    learning_rate: ClassVar[float] = 1e-4

    def fit(self, features: Features, name: str, *, is_final: bool = False) -> Checkpoint:
        """Return the model of the step that is best on a part of the objects."""
        problem, start = self.problem, self.problem.start
        training = start.config.training.with_given_weights(
            iterations=self.steps,
            distil_steps=DISTIL_STEPS,
            learning_rate=self.learning_rate,
            validate_every=max(1, self.steps // 10),
            freeze_towers=True,
            touches_per_batch=self.touches_per_batch,
        )
        config = dataclasses.replace(start.config, training=training)
        known = set(features.grasp_ids)
        grasps = [grasp for grasp in problem.grasps if grasp.grasp_id in known]
        split = make_split(grasps, validation=VALIDATION_FRACTION, test=0, seed=training.seed)
        config = config if is_final else config.without_candidate_encoder()
        out = problem.folder / f"{name}.safetensors"
        source = FrozenFeatures(features_by_image(grasps, features, default_device()))
        made_from = {"source": "", "data_digest": features.digest}
        trainer = Trainer(config, split, grasps, out, made_from, source, start.matcher.state_dict())
        fitted = trainer.run_or_reuse(on_step=problem.on_step if is_final else None)
        return dataclasses.replace(fitted, provenance={key: fitted.provenance[key] for key in ("step", "metrics")})
