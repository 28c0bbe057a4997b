"""Trials of the human baseline: a person matches a touch with one of ten photos.

In Lin, Calandra and Levine (ICRA 2019) people did 420 such trials. Here a trial uses objects of a recording that the
model was not trained on: a grasp, a photo of the same object from another grasp, and one photo of each of nine other
objects. Everybody gets the same trials in the same order.
"""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from retrieval.data.dataset import Grasp, finger_count, load_grasps
from retrieval.errors import BadInput
from retrieval.search.embeddings import embed_photos
from retrieval.serve.generations import ServedGeneration

CHOICES = 10


@dataclass(frozen=True)
class Trial:
    """The grasp whose touch is shown, the photos to choose from, and the number from 1 of the right one."""

    grasp: Grasp
    photos: tuple[Path, ...]
    truth: int


class Trials:
    """The trials of the recording in a folder. Raises DatasetError if it cannot be read."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._grasps = load_grasps(folder)
        self._by_object: dict[str, list[Grasp]] = defaultdict(list)
        for grasp in self._grasps:
            self._by_object[grasp.object_id].append(grasp)

    def unseen(self, generation: ServedGeneration) -> list[str]:
        """Return the objects that the model was neither trained nor calibrated on, sorted."""
        split = generation.checkpoint.split
        training_objects = {*split.train, *split.validation} if split else set()
        return sorted(set(self._by_object) - training_objects)

    def trial(self, generation: ServedGeneration, number: int) -> Trial:
        """Return a trial by its number, from 1.

        Raises:
            BadInput: The recording has too few unseen objects, or another number of fingers than the model.
        """
        names = self.unseen(generation)
        if len(names) < CHOICES:
            raise BadInput(
                f"A trial requires {CHOICES} objects that the model was not trained on; {self.folder} has {len(names)}."
            )
        if (fingers := finger_count(self._grasps)) != generation.fingers:
            raise BadInput(f"The model takes {generation.fingers} gel image(s); {self.folder} has {fingers}.")
        cycle, place = divmod(number - 1, len(names))  # each cycle shows every object once
        name = names[np.random.default_rng(cycle).permutation(len(names))[place]]
        rng = np.random.default_rng([cycle, place])
        own = self._by_object[name]
        grasp = own[rng.integers(len(own))]
        others = [each for each in own if each.photo != grasp.photo] or [grasp]
        distractors = rng.permutation([other for other in names if other != name])[: CHOICES - 1]
        groups = [self._by_object[str(other)] for other in distractors]
        photos = [grasps[rng.integers(len(grasps))].photo for grasps in groups]
        truth = int(rng.integers(CHOICES))
        photos.insert(truth, others[rng.integers(len(others))].photo)
        return Trial(grasp, tuple(photos), truth + 1)

    def model_choice(self, generation: ServedGeneration, trial: Trial) -> int:
        """Return the model's choice in a trial, counted from 1: the photo with the largest match logit."""
        background = generation.searcher.checkpoint.config.preprocessing.background
        reference = trial.grasp.backgrounds if background != "none" else None
        partials = generation.searcher.encode([trial.grasp.touches], background=reference).partials
        photos = embed_photos(trial.photos, model=generation.checkpoint).partials
        return int(generation.searcher.scorer.logits(partials, photos).argmax()) + 1
