"""Choice of the recipe that identifies objects best, by touches of objects that the fits have not seen.

recording -> folds of objects -> features of each recipe's towers -> fits without a fold, scores of its touches
-> the best recipe -> its fit to all objects, calibrated on those scores

The accuracy of the choice is nested: for the objects of a fold, the recipe is chosen by the other folds.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.console.interruption import resumable
from retrieval.console.output import say
from retrieval.console.progress import Bar
from retrieval.data.dataset import DataLicence, Grasp, finger_count, linked_objects, object_kinds, recording_camera
from retrieval.errors import BadInput
from retrieval.metrics.measure import Measure, pooled
from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.model.encode import one_thread
from retrieval.model.shipped import shipped_model
from retrieval.training.calibration.checkpoint import refused_touches, with_calibrations, with_sensor_calibrations
from retrieval.training.calibration.scores import ScoredTouches, score_touches
from retrieval.training.features import Features, encode_recording
from retrieval.training.loop import OnStep
from retrieval.training.recipes import RECIPES
from retrieval.training.recipes.recipe import Problem, Recipe
from retrieval.training.selection import (
    COMPARED,
    LOW_PASS,
    accuracy_row,
    comparison_table,
    draw_folds,
    objects_of_two_sessions,
)

CONTROL = "linear"
"""Recipe of the low-pass control."""
ENOUGH_OBJECTS = 150
"""Objects that are held out, in as many folds as needed: more do not change a choice, and every fold costs a fit."""
MAX_TOUCHES, MAX_TOUCHES_OF_OBJECT = 2_000, 60
"""Touches that are held out and scored."""
DRAWS = 4
"""Random photos of each object with which a touch is compared."""
MIN_OBJECTS = 8
"""Minimum number of objects: two folds of four, which trained heads divide again."""
CHOSEN = "chosen recipe"


def fit_best(
    recording: Path, problem: Problem, recipe: str | type[Recipe] | None
) -> tuple[Checkpoint, list[DataLicence]]:
    """Fit a matcher by the best recipe, or by the only one; return it, and the licences of its data."""
    names, folds = _candidates(problem, recipe)
    recipes = {name: RECIPES.load(name)(problem) for name in dict.fromkeys([*names, CONTROL])}
    with resumable(problem.folder):
        comparison = Comparison(problem, folds[: -(-ENOUGH_OBJECTS // len(folds[0]))])
        held_out = {name: comparison.held_out(name, recipes[name]) for name in names}
        low_pass = comparison.held_out(CONTROL, recipes[CONTROL], "low_pass")
        accuracies = {name: identification(parts) for name, parts in held_out.items()}
        best = max(names, key=lambda name: float(accuracies[name].by_object()[1].mean()))  # among equals the first
        features = comparison.features(recipes[best])
        fitted = recipes[best].fit(features, "final", is_final=True)
        parts = [part for part in held_out[best] if part.touches.has_trials]
        fitted = with_sensor_calibrations(fitted, problem.grasps, features)
        refused = np.array(features.grasp_ids)[refused_touches(fitted, torch.from_numpy(features.touch_rows))]
        is_refused = [np.isin(part.grasp_ids, refused) for part in parts]
        fitted = with_calibrations(fitted, [part.touches for part in parts], is_refused)
    table = _table(
        accuracies, identification(low_pass), _groups(comparison.folds), across_sessions=comparison.across_sessions
    )
    provenance = {
        **fitted.provenance,
        "recipe": best,
        COMPARED: table,
        "metrics": fitted.provenance.get("metrics", {})
        | {"held_out_top1": table["rows"][CHOSEN][0], "held_out_top1_chance": table["rows"][CHOSEN][3]},
    }
    return dataclasses.replace(fitted, provenance=provenance), recipes[best].licences(recording)


def _candidates(problem: Problem, recipe: str | type[Recipe] | None) -> tuple[list[str], list[tuple[str, ...]]]:
    """Return the names of the recipes that can be compared, or of the only one, and the folds of objects.

    Raises:
        BadInput: There are too few objects or grasps, or the recipe cannot be fitted.
    """
    objects = {grasp.object_id for grasp in problem.grasps}
    if len(objects) < MIN_OBJECTS or len(objects) == len(problem.grasps):
        raise BadInput(
            f"A fit needs at least {MIN_OBJECTS} objects with two grasps each, got {len(objects)} objects with "
            f"{len(problem.grasps)} grasps. Record more."
        )
    testable = objects_of_two_sessions(problem.grasps, MIN_OBJECTS) or objects
    split = problem.start.split
    unknown = testable.difference((*split.train, *split.validation) if split else ())
    kinds = {name: RECIPES.load(name) for name in (RECIPES.names() if recipe is None else [RECIPES.name_of(recipe)])}
    if len(unknown) < MIN_OBJECTS:
        kinds = {name: kind for name, kind in kinds.items() if not kind.uses_start}
        say("The start model was trained on these objects, so recipes that use it cannot be tested and are left out")
    else:
        testable = unknown
    obstacles = {name: kind.obstacle(problem) for name, kind in kinds.items()}
    names = [name for name, obstacle in obstacles.items() if not obstacle]
    if not names:
        reason = next(iter(obstacles.values()), "the start model was trained on these objects")
        raise BadInput(f"Recipe {recipe} does not apply: {reason}. Leave the recipe out.")
    return names, draw_folds([group for group in problem.linked if testable.issuperset(group)])


def pose(
    recording: Path,
    grasps: list[Grasp],
    folder: Path,
    *,
    model: str | Path | Checkpoint | None = None,
    init: str = "imagenet",
    on_step: OnStep | None = None,
) -> Problem:
    """Return the problem of grasps of a recording; unfinished parts are stored in `folder`."""
    fingers = finger_count(grasps)
    start = model if isinstance(model, Checkpoint) else load_checkpoint(model or shipped_model(min(fingers, 2)))
    kinds, linked = object_kinds(recording), linked_objects(grasps)
    camera = recording_camera(recording, grasps, start.config.preprocessing)
    return Problem(grasps, camera, fingers, start, init, kinds, linked, folder, on_step)


# Touches of held-out objects -------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOut:
    """Touches of objects that a fit has not seen.

    Attributes:
        touches: The touches, with match logits.
        object_ids: The objects, by their numbers in `touches`.
        grasp_ids: The grasp of each touch.
    """

    touches: ScoredTouches
    object_ids: tuple[str, ...]
    grasp_ids: tuple[str, ...]


class Comparison:
    """Fits of recipes without the objects of each fold, scored on these objects."""

    def __init__(self, problem: Problem, folds: Sequence[Sequence[str]]) -> None:
        problem.folder.mkdir(parents=True, exist_ok=True)
        self.problem, self.folds = problem, folds
        sessions = list(dict.fromkeys(grasp.session for grasp in problem.grasps))
        self._session_of = {grasp.grasp_id: sessions.index(grasp.session) for grasp in problem.grasps}
        self.across_sessions = bool(objects_of_two_sessions(problem.grasps, MIN_OBJECTS))
        objects = sum(map(len, folds))
        self._max_touches = min(max(MAX_TOUCHES // objects, 2), MAX_TOUCHES_OF_OBJECT)

    def features(self, recipe: Recipe, variant: str = "touch") -> Features:
        """Return the features of all grasps by the towers of a recipe; a tower of several recipes encodes once."""
        problem = self.problem
        return encode_recording(
            problem.grasps, recipe.matcher, recipe.config, problem.folder, touch_variant=variant, camera=problem.camera
        )

    def held_out(self, name: str, recipe: Recipe, variant: str = "touch") -> list[HeldOut]:
        """Return the scored touches of each fold."""
        features, parts = self.features(recipe, variant), []
        with Bar(f"testing: {recipe.label}", len(self.folds), "folds") as bar:
            for number, fold in enumerate(self.folds):
                is_held_out = np.isin(features.object_ids, fold)
                fitted = recipe.fit(features.select(np.flatnonzero(~is_held_out)), f"{name}-{variant}-{number}")
                parts.append(self._scored(fitted, features.select(np.flatnonzero(is_held_out))))
                bar.advance()
        return parts

    @one_thread()
    def _scored(self, fitted: Checkpoint, features: Features) -> HeldOut:
        """Score touches, at most so many of an object, with photos of other grasps, of other sessions if possible."""
        rows = [np.flatnonzero(features.owner == owner) for owner in np.unique(features.owner)]
        places = [np.linspace(0, len(part) - 1, min(len(part), self._max_touches)).astype(int) for part in rows]
        features = features.select(np.concatenate([part[some] for part, some in zip(rows, places, strict=True)]))
        sessions = np.array([self._session_of[name] for name in features.grasp_ids])
        own = np.eye(len(features), dtype=np.bool_)
        if self.across_sessions:
            own = sessions[:, None] == sessions
        tensors = torch.from_numpy(features.touch_rows), torch.from_numpy(features.photo)
        group = sessions if self.across_sessions else None
        scored = score_touches(fitted.matcher, tensors, (features.owner, features.owner), own, group)
        return HeldOut(scored, tuple(sorted(set(features.object_ids))), features.grasp_ids)


def identification(parts: Sequence[HeldOut]) -> Measure:
    """Return how often a random photo of the touched object has the highest logit among one of each object of the fold.

    Photos of the touch's own grasp, or session, are not drawn; 1/m if m photos tie.

    Raises:
        BadInput: No touch has another photo of its object.
    """
    numbers = {name: number for number, name in enumerate(sorted(name for part in parts for name in part.object_ids))}
    measures = []
    for part in parts:
        touches, objects, rng = part.touches, len(part.object_ids), np.random.default_rng([0, 8])
        values, logits = np.zeros(len(touches.logits)), np.where(touches.own, -np.inf, touches.logits)
        photos_of = [np.flatnonzero(touches.photo_owner == owner) for owner in range(objects)]
        for _ in range(DRAWS):
            keys = np.where(touches.own, -1.0, rng.random(touches.own.shape))
            drawn = np.stack([photos[keys[:, photos].argmax(1)] for photos in photos_of], axis=1)
            scores = np.take_along_axis(logits, drawn, 1)
            right = np.take_along_axis(scores, touches.touch_owner[:, None], 1)
            values += np.where((scores > right).any(1), 0.0, 1 / (scores == right).sum(1)) / DRAWS
        rows = np.flatnonzero(np.isfinite(right[:, 0]))
        if len(rows):
            owner = np.array([numbers[part.object_ids[place]] for place in touches.touch_owner[rows]])
            measures.append(Measure(values[rows, None], owner, np.array([1 / objects]), ""))
    if not measures:
        raise BadInput("no touch has another photo of its object; record at least two grasps of each object")
    return pooled(measures)


# The result ------------------------------------------------------------------------------------------------


def _groups(folds: Sequence[Sequence[str]]) -> NDArray[np.int64]:
    """Return the group (O,) of each object, in order of names: its fold, or one of two halves of a single fold."""
    if len(folds) == 1:
        return np.arange(len(folds[0])) % 2
    fold_of = {name: number for number, fold in enumerate(folds) for name in fold}
    return np.array([fold_of[name] for name in sorted(fold_of)])


def _table(
    accuracies: dict[str, Measure], low_pass: Measure, groups: NDArray[np.int64], *, across_sessions: bool
) -> dict[str, Any]:
    """Return the accuracy of each recipe, of the choice by the objects of other `groups` (O,), and of the control."""
    first = next(iter(accuracies.values()))
    objects, means = first.by_object()[0], np.stack([each.by_object()[1][:, 0] for each in accuracies.values()])
    chosen, groups = np.empty((len(objects), 1)), groups[objects]
    for group in np.unique(groups):
        best = means[:, groups != group].mean(1).argmax()
        chosen[groups == group, 0] = means[best, groups == group]
    choice = Measure(chosen, np.arange(len(chosen)), first.chance, "")
    rows = {**accuracies, CHOSEN: choice, LOW_PASS: low_pass}
    gallery = f"about {round(1 / first.chance[0])} objects that no fit has seen, one photo of each"
    accuracies_by_name = {name: accuracy_row(row) for name, row in rows.items()}
    return comparison_table(gallery, accuracies_by_name, choice, low_pass, across_sessions=across_sessions)
