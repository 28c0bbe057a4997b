"""Ceilings: how well each side alone knows the object, and so which side is short. Printed beside the result."""

import dataclasses

from retrieval.evaluation.experiment import Experiment
from retrieval.training.features import Features

CEILING_METHOD = "cca"
CEILINGS = {
    "touch_to_touch": "the touch of another grasp stands in for the photo: what can be felt twice",
    "photo_to_photo": "the photo of another grasp stands in for the touch: what can be seen twice",
}


def ceiling_experiments(experiment: Experiment) -> dict[str, Experiment]:
    """The experiment of each ceiling. A grasp is never asked with itself, as no touch is with its own photo."""
    features, folder = experiment.features, experiment.folder / "ceilings"
    seen_twice = {
        "touch_to_touch": dataclasses.replace(features, photo=features.touch.reshape(len(features), -1)),
        "photo_to_photo": dataclasses.replace(features, touch=features.photo[:, None]),
    }
    return {
        name: dataclasses.replace(
            experiment, folder=folder / name, features=twice, pairs=None, checkpoint=None, role=f"ceiling: {name}"
        )
        for name, twice in seen_twice.items()
        if _is_taken_twice(features, name)
    }


def _is_taken_twice(features: Features, name: str) -> bool:
    """Whether an object has two photos to tell apart; a touch is always a grasp's own."""
    if name == "touch_to_touch":
        return True
    photos = {(owner, row.tobytes()) for owner, row in zip(features.owner.tolist(), features.photo, strict=True)}
    return len(photos) > len(set(features.object_ids))
