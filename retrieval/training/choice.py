"""Choice of the recipe that identifies objects best, by touches of objects that the fits have not seen.

recording -> folds of objects -> features of each recipe's towers -> fits without a fold, scores of its touches
-> the best recipe -> its fit to all objects, calibrated on those scores -> checkpoint

The accuracy of the choice is nested: for the touches of an object, the recipe is chosen by the other objects.
"""

import dataclasses
import shutil
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retrieval.console.interruption import resumable
from retrieval.console.progress import Bar
from retrieval.data.dataset import (
    LICENCES,
    AnyRecording,
    Grasp,
    Split,
    data_digest,
    finger_count,
    folder_of,
    linked_objects,
    load_grasps,
    object_kinds,
    recording_licence,
    recording_source,
)
from retrieval.errors import BadInput
from retrieval.metrics.measure import Measure, pooled
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, require_writable, sibling_file, store_checkpoint
from retrieval.model.encode import one_thread
from retrieval.model.shipped import shipped_model
from retrieval.training.calibration import ScoredTouches, score_touches, with_calibrations, with_sensor_calibrations
from retrieval.training.features import Features, encode_recording
from retrieval.training.initial_weights import checkpoint_licences
from retrieval.training.recipes import RECIPES
from retrieval.training.recipes.recipe import Problem, Recipe
from retrieval.training.selection import (
    COMPARED,
    LOW_PASS,
    MIN_OBJECTS,
    accuracy_row,
    comparison_table,
    draw_folds,
)

CONTROL = "linear"
"""Recipe of the low-pass control."""
ENOUGH_OBJECTS = 150
"""Objects that are held out, in as many folds as needed: more do not change a choice, and every fold costs a fit."""
MAX_TOUCHES, MAX_TOUCHES_OF_OBJECT = 2_000, 60
"""Touches that are held out and scored."""
DRAWS = 4
"""Random photos of each object with which a touch is compared."""
CHOSEN = "chosen recipe"


def train_best(
    recording: AnyRecording,
    out: Path,
    *,
    recipe: str | type[Recipe] | None = None,
    model: str | Path | Checkpoint | None = None,
    init: str = "imagenet",
    split: Split | None = None,
    quiet: bool = False,
) -> Checkpoint:
    """Fit a matcher by the best recipe, and write the checkpoint `out`; arguments as for `retrieval.train`."""
    require_writable(out)
    recording, folder = folder_of(recording), sibling_file(out, ".parts")
    problem = pose(recording, folder, model=model, init=init, unused=split.test if split else (), quiet=quiet)
    grasps, start, fingers = problem.grasps, problem.start, problem.fingers
    folds = draw_folds(problem.linked)
    objects = sum(map(len, folds))
    if recipe is not None:
        names = [RECIPES.name_of(recipe)]
        if not RECIPES.load(names[0]).applies(problem, objects):
            raise BadInput(
                f"recipe {names[0]} does not apply: the recording has {objects} objects and {fingers} gel image(s) for "
                f"each touch, the start model takes {start.config.matcher.fingers}. Leave the recipe out"
            )
    else:
        names = [name for name in RECIPES.names() if RECIPES.load(name).applies(problem, objects)]
    recipes = {name: RECIPES.load(name)(problem) for name in dict.fromkeys([*names, CONTROL])}
    with resumable(folder):
        comparison = Comparison(problem, folds[: -(-ENOUGH_OBJECTS // len(folds[0]))])
        held_out = {name: comparison.held_out(name, recipes[name]) for name in names}
        low_pass = comparison.held_out(CONTROL, recipes[CONTROL], "low_pass")
        accuracies = {name: identification(parts) for name, parts in held_out.items()}
        best = max(names, key=lambda name: float(accuracies[name].by_object()[1].mean()))  # among equals the first
        made = recipes[best].fit(comparison.features(recipes[best]), "final", is_final=True)
        made = _calibrated(made, held_out[best])
        made = with_sensor_calibrations(made, grasps, comparison.features(recipes[best]), quiet=quiet)
    about = {"source": recording_source(recording), "data_digest": data_digest(grasps)}
    licences = dict.fromkeys([*checkpoint_licences(start), recording_licence(recording)])
    table = _table(accuracies, identification(low_pass))
    origin = {"calibrated_on": about} if made.matcher is start.matcher else about
    provenance = {
        **made.provenance,
        **origin,
        LICENCES: [dataclasses.asdict(licence) for licence in licences],
        "recipe": best,
        COMPARED: table,
        "metrics": {"held_out_top1": table["rows"][CHOSEN][0], "held_out_top1_chance": table["rows"][CHOSEN][3]},
    }
    store_checkpoint(dataclasses.replace(made, provenance=provenance), out)
    shutil.rmtree(folder)
    return load_checkpoint(out)


def pose(
    recording: Path,
    folder: Path,
    *,
    model: str | Path | Checkpoint | None = None,
    init: str = "imagenet",
    unused: Collection[str] = (),
    quiet: bool = False,
) -> Problem:
    """Return the problem of a recording without the objects `unused`; `folder` is made for unfinished parts."""
    grasps = [grasp for grasp in load_grasps(recording) if grasp.object_id not in unused]
    fingers = finger_count(grasps)
    start = model if isinstance(model, Checkpoint) else load_checkpoint(model or shipped_model(min(fingers, 2)))
    folder.mkdir(parents=True, exist_ok=True)
    return Problem(grasps, fingers, start, init, object_kinds(recording), linked_objects(grasps), folder, quiet)


# Touches of held-out objects -------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOut:
    """Touches of objects that a fit has not seen.

    Attributes:
        touches: The touches, with match logits.
        pooled: The same without late interaction; None for a model without cells.
        object_ids: The objects, by their numbers in `touches`.
    """

    touches: ScoredTouches
    pooled: ScoredTouches | None
    object_ids: tuple[str, ...]


class Comparison:
    """Fits of recipes without the objects of each fold, scored on these objects."""

    def __init__(self, problem: Problem, folds: Sequence[Sequence[str]]) -> None:
        self.problem, self.folds = problem, folds
        self._encoded: dict[tuple[int, str], Features] = {}
        sessions = sessions_of(problem.grasps)
        self._session_of = {grasp.grasp_id: grasp.session for grasp in problem.grasps} if sessions else {}
        objects = sum(map(len, folds))
        self._max_touches = min(max(MAX_TOUCHES // objects, 2), MAX_TOUCHES_OF_OBJECT)

    def features(self, recipe: Recipe, variant: str = "touch") -> Features:
        """Return the features of all grasps by the towers of a recipe; each tower encodes once."""
        key = id(recipe.matcher), variant
        if key not in self._encoded:
            photos = None if variant == "touch" else self.features(recipe)
            self._encoded[key] = encode_recording(
                self.problem.grasps,
                recipe.matcher,
                recipe.config,
                self.problem.folder,
                touch_variant=variant,
                photo_features_from=photos,
                quiet=self.problem.quiet,
            )
        return self._encoded[key]

    def held_out(self, name: str, recipe: Recipe, variant: str = "touch") -> list[HeldOut]:
        """Return the scored touches of each fold."""
        features, parts = self.features(recipe, variant), []
        with Bar(f"testing: {recipe.label}", len(self.folds), "folds", quiet=self.problem.quiet) as bar:
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
        own = np.eye(len(features), dtype=np.bool_)
        if self._session_of:
            sessions = np.array([self._session_of[name] or "" for name in features.grasp_ids])
            own = sessions[:, None] == sessions
        tensors = torch.from_numpy(features.touch_rows), torch.from_numpy(features.photo)
        owners = features.owner, features.owner
        has_cells = bool(fitted.config.matcher.cell_dim)
        return HeldOut(
            score_touches(fitted.matcher, tensors, owners, own),
            score_touches(fitted.matcher, tensors, owners, own, pooled=True) if has_cells else None,
            tuple(sorted(set(features.object_ids))),
        )


def sessions_of(grasps: Sequence[Grasp]) -> set[str]:
    """Return the sessions of grasps if at least `MIN_OBJECTS` objects were touched in two, else nothing."""
    seen: dict[str, set[str]] = {}
    for grasp in grasps:
        seen.setdefault(grasp.object_id, set()).add(grasp.session or "")
    repeated = sum(len(sessions) > 1 for sessions in seen.values())
    return set().union(*seen.values()) if repeated >= MIN_OBJECTS else set()


def identification(parts: Sequence[HeldOut]) -> Measure:
    """Return how often a random photo of the touched object has the highest logit among one of each object of the fold.

    Photos of the touch's own grasp, or session, are not drawn; 1/m if m photos tie.

    Raises:
        BadInput: No touch has another photo of its object.
    """
    numbers = {name: number for number, name in enumerate(sorted(name for part in parts for name in part.object_ids))}
    measures = []
    for part in parts:
        touches, rng = part.touches, np.random.default_rng([0, 8])
        values, objects = np.zeros(len(touches.logits)), len(part.object_ids)
        for _ in range(DRAWS):
            keys = np.where(touches.own, -1.0, rng.random(touches.own.shape))
            photos = np.stack([_drawn(keys, touches.photo_owner == owner) for owner in range(objects)], axis=1)
            scores = np.where(photos < 0, -np.inf, np.take_along_axis(touches.logits, np.maximum(photos, 0), 1))
            right = np.take_along_axis(scores, touches.touch_owner[:, None], 1)
            values += np.where((scores > right).any(1), 0.0, 1 / (scores == right).sum(1)) / DRAWS
        rows = np.flatnonzero(np.isfinite(right[:, 0]))
        if len(rows):
            owner = np.array([numbers[part.object_ids[place]] for place in touches.touch_owner[rows]])
            measures.append(Measure(values[rows, None], owner, np.array([1 / objects]), ""))
    if not measures:
        raise BadInput("no touch has another photo of its object; record at least two grasps of each object")
    return pooled(measures)


def _drawn(keys: NDArray[np.float64], is_photo: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the photo (T,) with the highest key among those of an object; -1 if all its keys are negative."""
    columns = np.flatnonzero(is_photo)
    places = keys[:, columns].argmax(1)
    return np.where(np.take_along_axis(keys[:, columns], places[:, None], 1)[:, 0] < 0, -1, columns[places])


# The result ------------------------------------------------------------------------------------------------


def _table(accuracies: dict[str, Measure], low_pass: Measure) -> dict[str, Any]:
    """Return the accuracy of each recipe, of the choice and of the control."""
    first = next(iter(accuracies.values()))
    means = np.stack([measure.by_object()[1][:, 0] for measure in accuracies.values()])
    of_others = means.sum(1, keepdims=True) - means
    chosen = np.take_along_axis(means, of_others.argmax(0)[None], 0).T
    choice = Measure(chosen, np.arange(len(chosen)), first.chance, "")
    rows = {**accuracies, CHOSEN: choice, LOW_PASS: low_pass}
    gallery = f"about {round(1 / first.chance[0])} objects that no fit has seen, one photo of each"
    return comparison_table(gallery, {name: accuracy_row(row) for name, row in rows.items()}, choice, low_pass)


def _calibrated(made: Checkpoint, parts: Sequence[HeldOut]) -> Checkpoint:
    """Return the model with calibrations on touches of objects that a fit of the same recipe has not seen."""
    return with_calibrations(
        made, [part.touches for part in parts], [part.pooled for part in parts if part.pooled is not None]
    )
