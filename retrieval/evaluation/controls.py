"""Controls and ceilings, printed next to the result.

A control is the same method where it must not be able to do what it does. A ceiling is how well each side alone knows
the object, and so which side is short.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from retrieval.data.dataset import Grasp
from retrieval.evaluation.data import EvaluationData
from retrieval.evaluation.experiment import Experiment
from retrieval.evaluation.queries import draw_queries
from retrieval.evaluation.scoring import MethodScores, summaries
from retrieval.training.features import encode_recording

CONTROL_METHOD = "late_fusion"
CONTROL_MEASURES = ("pair_accuracy", "topn_k5", "topn_k10")
CONTROLS = {
    "shuffled": "touches are dealt to other objects before fitting, so that there is nothing to learn",
    "no_contact": "the frames taken before the contact stand in for the touch, in fitting and in judging",
    "low_pass": "each gel image is reduced to a blur of 8 x 6 pixels, in fitting and in judging",
}
CEILING_METHOD = "cca"
CEILINGS = {
    "touch_to_touch": "the touch of another grasp stands in for the photo: what can be felt twice",
    "photo_to_photo": "the photo of another grasp stands in for the touch: what can be seen twice",
}
MAX_GRASPS = 12
"""Grasps of an object whose other images are encoded for a control."""
MAX_PAIRS = 2000
"""Labelled pairs, of all, whose other images are encoded for a control."""


def control_experiments(experiment: Experiment, data: EvaluationData, cache: Path, seed: int) -> dict[str, Experiment]:
    """The experiment of each control; "before" is left out where the recording lacks frames from before the contact."""
    folder, unfitted = experiment.folder / "controls", dataclasses.replace(experiment, checkpoint=None)
    experiments = {
        "shuffled": dataclasses.replace(unfitted, folder=folder / "shuffled", shuffled=True, role="control: shuffled")
    }
    grasps = thin_grasps(data.grasps, MAX_GRASPS)
    queries = draw_queries(grasps, data.split, seed)
    pairs = data.pairs[:: len(data.pairs) // MAX_PAIRS + 1]
    for touch_variant in ("no_contact", "low_pass"):
        if touch_variant == "no_contact" and not all(len(grasp.backgrounds) == len(grasp.touches) for grasp in grasps):
            continue
        towers = data.matcher, data.config
        shown = partial(encode_recording, cache=cache, touch_variant=touch_variant, quiet=experiment.quiet)
        experiments[touch_variant] = dataclasses.replace(
            unfitted,
            folder=folder / touch_variant,
            features=shown(grasps, *towers, photo_features_from=experiment.features),
            pairs=shown(pairs, *towers, photo_features_from=experiment.pairs) if pairs else None,
            queries=queries,
            role=f"control: {touch_variant}",
        )
    return experiments


def thin_grasps(grasps: Sequence[Grasp], max_grasps: int) -> list[Grasp]:
    """At most so many grasps of each object, evenly spaced over its own."""
    rows_of: dict[str, list[int]] = defaultdict(list)
    for row, grasp in enumerate(grasps):
        rows_of[grasp.object_id].append(row)
    kept: set[int] = set()
    for rows in rows_of.values():
        kept |= {rows[place] for place in np.linspace(0, len(rows) - 1, min(max_grasps, len(rows))).astype(int)}
    return [grasps[row] for row in sorted(kept)]


def score_control(description: str, method: str, experiment: Experiment, seed: int, *, draws: int) -> dict[str, Any]:
    """The entry of results.json of a control or a ceiling."""
    judged = MethodScores(experiment.queries, experiment.run(method, seed), seed)
    return {"description": description, "measures": summaries([judged.measures(CONTROL_MEASURES)], draws, seed)}


def ceiling_experiments(experiment: Experiment) -> dict[str, Experiment]:
    """The experiment of each ceiling; that of photos only where an object has two to tell apart.

    A grasp is never asked with itself, as no touch is with its own photo.
    """
    features, folder = experiment.features, experiment.folder / "ceilings"
    twice = {"touch_to_touch": dataclasses.replace(features, photo=features.touch.reshape(len(features), -1))}
    photos = {(owner, row.tobytes()) for owner, row in zip(features.owner.tolist(), features.photo, strict=True)}
    if len(photos) > len(set(features.object_ids)):
        twice["photo_to_photo"] = dataclasses.replace(features, touch=features.photo[:, None])
    return {
        name: dataclasses.replace(
            experiment, folder=folder / name, features=each, pairs=None, checkpoint=None, role=f"ceiling: {name}"
        )
        for name, each in twice.items()
    }
