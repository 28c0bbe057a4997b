"""Controls and ceilings, reported next to the result.

A control runs the same method on inputs that lack information that the method should use. A ceiling measures how well
each single modality identifies the object, and so which modality limits the result.
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
    "shuffled": "touches are randomly assigned to other objects before fitting, so there is nothing to learn",
    "no_contact": "no-contact frames replace the touches, in fitting and in scoring",
    "low_pass": "each gel image is reduced to 8 x 6 pixels, in fitting and in scoring",
}
CEILING_METHOD = "cca"
CEILINGS = {
    "touch_to_touch": "the touch of another grasp replaces the photo: how repeatable touches are",
    "photo_to_photo": "the photo of another grasp replaces the touch: how repeatable photos are",
}
MAX_GRASPS = 12
"""Maximum number of grasps of one object that are encoded for a control."""


def control_experiments(experiment: Experiment, data: EvaluationData, cache: Path, seed: int) -> dict[str, Experiment]:
    """Return the experiment of each control, by its name in `CONTROLS`.

    "no_contact" is left out if the recording lacks no-contact frames.

    Args:
        experiment: The experiment of the evaluation.
        data: The recording, its split and its towers.
        cache: Folder of encoded features.
        seed: Seed of the queries.
    """
    folder, unfitted = experiment.folder / "controls", dataclasses.replace(experiment, checkpoint=None)
    experiments = {
        "shuffled": dataclasses.replace(unfitted, folder=folder / "shuffled", shuffled=True, role="control: shuffled")
    }
    grasps = thin_grasps(data.grasps, MAX_GRASPS)
    queries = draw_queries(grasps, data.split, seed)
    for touch_variant in ("no_contact", "low_pass"):
        if touch_variant == "no_contact" and not all(len(grasp.backgrounds) == len(grasp.touches) for grasp in grasps):
            continue
        towers = data.matcher, data.config
        encode = partial(encode_recording, cache=cache, touch_variant=touch_variant, quiet=experiment.quiet)
        experiments[touch_variant] = dataclasses.replace(
            unfitted,
            folder=folder / touch_variant,
            features=encode(grasps, *towers, photo_features_from=experiment.features),
            queries=queries,
            role=f"control: {touch_variant}",
        )
    return experiments


def thin_grasps(grasps: Sequence[Grasp], max_grasps: int) -> list[Grasp]:
    """Return at most `max_grasps` grasps of each object, evenly spaced in the order of its grasps."""
    rows_of: dict[str, list[int]] = defaultdict(list)
    for row, grasp in enumerate(grasps):
        rows_of[grasp.object_id].append(row)
    selected: set[int] = set()
    for rows in rows_of.values():
        selected |= {rows[place] for place in np.linspace(0, len(rows) - 1, min(max_grasps, len(rows))).astype(int)}
    return [grasps[row] for row in sorted(selected)]


def score_control(description: str, method: str, experiment: Experiment, seed: int, *, draws: int) -> dict[str, Any]:
    """Return the results.json entry of a control or a ceiling."""
    method_scores = MethodScores(experiment.queries, experiment.run(method, seed), seed)
    return {"description": description, "measures": summaries([method_scores.measures(CONTROL_MEASURES)], draws, seed)}


def ceiling_experiments(experiment: Experiment) -> dict[str, Experiment]:
    """Return the experiment of each ceiling, by its name in `CEILINGS`.

    "photo_to_photo" is left out if no object has two different photos. A grasp is never compared with itself, as no
    touch is compared with its own photo.
    """
    features, folder = experiment.features_for(CEILING_METHOD), experiment.folder / "ceilings"
    experiments = {"touch_to_touch": dataclasses.replace(features, photo=features.touch.reshape(len(features), -1))}
    photos = {(owner, row.tobytes()) for owner, row in zip(features.owner.tolist(), features.photo, strict=True)}
    if len(photos) > len(set(features.object_ids)):
        experiments["photo_to_photo"] = dataclasses.replace(features, touch=features.photo[:, None])
    return {
        name: dataclasses.replace(
            experiment,
            folder=folder / name,
            features=each,
            checkpoint=None,
            matcher=None,  # the features have no cells
            role=f"ceiling: {name}",
        )
        for name, each in experiments.items()
    }
