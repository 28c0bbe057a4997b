"""Fit and predict: write one file of predictions for each method and seed, unless it exists."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from retrieval.console.output import say
from retrieval.data.dataset import Split
from retrieval.evaluation.predictions import Predictions, predict, read_predictions, write_predictions
from retrieval.evaluation.queries import Queries
from retrieval.methods import METHODS
from retrieval.methods.late_fusion import LateFusion, checkpoint_path
from retrieval.methods.method import Method, MethodSettings
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.config import Config
from retrieval.model.encode import one_thread
from retrieval.model.fusion import Matcher
from retrieval.model.losses import LOSSES
from retrieval.training.features import Features
from retrieval.training.loop import code_digest
from retrieval.version import __version__


@dataclass(frozen=True, eq=False)
class Experiment:
    """Data, settings and queries on which methods are fitted and scored.

    Attributes:
        folder: Folder of fits and predictions.
        config: Configuration of the heads.
        split: Training, validation and test objects.
        features: Tower features of all grasps.
        queries: Touches and photos to score.
        checkpoint: A whole model, which late fusion and methods with its weights then use; None to fit them.
        shuffled: Whether touches are permuted among the objects of each part before fitting, as a control.
        quiet: No progress on stderr.
        fit_on_validation: As in `MethodSettings`.
        kind_of: As in `MethodSettings`.
        matcher: Matcher whose towers computed the features; methods without cells then get no cells. None if the
            features have none.
        role: Label for progress lines, such as "control: low_pass"; empty for the evaluation itself.
    """

    folder: Path
    config: Config
    split: Split
    features: Features
    queries: Queries
    checkpoint: Checkpoint | None
    shuffled: bool
    quiet: bool
    fit_on_validation: bool = False
    kind_of: Mapping[str, str] | None = None
    matcher: Matcher | None = None
    role: str = ""

    def seeds_of(self, name: str, seeds: list[int]) -> list[int]:
        """Return the seeds that change the result of a method."""
        method = METHODS.load(name)
        is_fitted = self.checkpoint is not None and issubclass(method, LateFusion)
        return seeds[:1] if is_fitted or not method.is_seeded else seeds

    def run(self, name: str, seed: int) -> Predictions:
        """Return the stored predictions of a method, or fit it and store them."""
        path, cache_key = self.folder / "predictions" / f"{name}-{seed}.safetensors", self.cache_key(name, seed)
        if (stored := read_predictions(path, cache_key)) is not None:
            return stored
        if not self.quiet:
            say(f"evaluate: {name}, seed {seed}" + (f" ({self.role})" if self.role else ""))
        method, fit_s = self._fit(name, seed)
        predictions = predict(method, self.features_for(name), self.queries, fit_s)
        write_predictions(path, predictions, cache_key)
        return predictions

    def late_fusion_checkpoint(self, seed: int) -> Checkpoint:
        """Return the given checkpoint, or the one that late fusion trained with this seed."""
        return self.checkpoint or load_checkpoint(checkpoint_path(self.folder / "fits", seed))

    def cache_key(self, name: str, seed: int) -> dict[str, Any]:
        """Return all inputs that determine the predictions of a method, in JSON types."""
        losses = [LOSSES.load(loss) for loss, weight in self.config.training.weights.items() if weight > 0]
        return {
            "method": name,
            "seed": seed,
            "features": self.features.digest,
            "queries": self.queries.digest,
            "split": self.split.to_dict(),
            "config": self.config.without_paths(),
            "model": self.checkpoint.digest if self.checkpoint else None,
            "shuffled": self.shuffled,
            "fit_on_validation": self.fit_on_validation,
            "software": __version__,
            **code_digest(METHODS.load(name), *losses),
        }

    def _fit(self, name: str, seed: int) -> tuple[Method, float]:
        config = self.config.without_candidate_encoder() if self.shuffled else self.config  # no ranking to learn
        settings = MethodSettings(config, seed, self.folder / "fits", self.quiet, self.fit_on_validation, self.kind_of)
        method = METHODS.load(name)(settings)
        if self.checkpoint is not None and isinstance(method, LateFusion):
            return type(method).of_checkpoint(self.checkpoint, method.settings), 0.0
        features = self.features_for(name)
        train, validation = (features.of_objects(part) for part in (self.split.train, self.split.validation))
        if self.shuffled:
            train, validation = _permute_touches(train, seed), _permute_touches(validation, seed)
        start = time.perf_counter()
        with one_thread():  # heads are small; times refer to one core
            method.fit(train, validation)
        return method, time.perf_counter() - start

    def features_for(self, name: str) -> Features:
        """Return the features as a method takes them: without cells, or with them."""
        if self.matcher is None or METHODS.load(name).uses_cells:
            return self.features
        return self.features.pooled(self.matcher)


def _permute_touches(features: Features, seed: int) -> Features:
    """Return the features with touches randomly assigned to grasps."""
    order = np.random.default_rng([seed, 13]).permutation(len(features))
    return Features(features.grasp_ids, features.object_ids, features.touch[order], features.photo)
