"""The human test: a touch is shown, and ten photos, one of them of the object that was touched.

Lin, Calandra and Levine (ICRA 2019) had people do 420 such trials. Here they are drawn from a recording's objects that
the model never saw: a grasp, a photo of the same object from another grasp, and a photo each of nine other objects. A
series is a seed, so that it is drawn again wherever it is asked for.
"""

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock

import numpy as np

from retrieval.data.dataset import Grasp, finger_count, load_grasps
from retrieval.errors import BadInput
from retrieval.metrics.k_way import binomial_interval
from retrieval.search.embeddings import embed_photos
from retrieval.serve.generations import ServedGeneration
from retrieval.serve.store import TrialChoice

CHOICES = 10


@dataclass(frozen=True)
class Trial:
    """A grasp whose touch is shown, and the photos to choose from; truth: the right one, counted from 1."""

    grasp: Grasp
    photos: tuple[Path, ...]
    truth: int


@dataclass(frozen=True)
class TrialAccuracy:
    """How many trials were right, and the exact interval of 95 % (Clopper and Pearson 1934); None before the first."""

    right: int
    trials: int
    accuracy: float | None
    low: float | None
    high: float | None


def trial_accuracy(right: int, trials: int) -> TrialAccuracy:
    """The share and its interval."""
    if not trials:
        return TrialAccuracy(0, 0, None, None, None)
    low, high = binomial_interval(right, trials)
    return TrialAccuracy(right, trials, right / trials, low, high)


def trial_accuracies(choices: list[TrialChoice]) -> tuple[TrialAccuracy, TrialAccuracy]:
    """The shares of right choices: of the person, and of the model in the same trials."""
    right = [sum(one.choice == one.truth for one in choices), sum(one.model == one.truth for one in choices)]
    return trial_accuracy(right[0], len(choices)), trial_accuracy(right[1], len(choices))


class Trials:
    """The trials of one recording. Raises DatasetError for one that cannot be read."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._grasps = load_grasps(folder)
        self._lock = Lock()

    @cached_property
    def _by_object(self) -> dict[str, list[Grasp]]:
        found: dict[str, list[Grasp]] = defaultdict(list)
        for grasp in self._grasps:
            found[grasp.object_id].append(grasp)
        return found

    def unseen(self, generation: ServedGeneration) -> list[str]:
        """Objects that the model was neither trained nor calibrated on, sorted."""
        split = generation.checkpoint().split
        seen = {*split.train, *split.validation} if split else set()
        return sorted(set(self._by_object) - seen)

    def trial(self, generation: ServedGeneration, seed: int, number: int) -> Trial:
        """Trial `number`, from 1, of a series. Raises BadInput where the recording has too few unseen objects, or the
        model is for another number of fingers.
        """
        names = self.unseen(generation)
        if len(names) < CHOICES:
            raise BadInput(
                f"a trial needs {CHOICES} objects that the model was not trained on; {self.folder} has {len(names)}"
            )
        if (fingers := finger_count(self._grasps)) != generation.fingers:
            raise BadInput(f"the model takes {generation.fingers} gel image(s); {self.folder} has {fingers}")
        turn, place = divmod(number - 1, len(names))  # every object once before any comes again
        name = names[np.random.default_rng([seed, turn]).permutation(len(names))[place]]
        rng = np.random.default_rng([seed, turn, place])
        own = self._by_object[name]
        grasp = own[rng.integers(len(own))]
        others = [each for each in own if each.photo != grasp.photo] or [grasp]
        drawn = rng.permutation([other for other in names if other != name])[: CHOICES - 1]
        photos = [self._by_object[str(other)] for other in drawn]
        shown = [each[rng.integers(len(each))].photo for each in photos]
        truth = int(rng.integers(CHOICES))
        shown.insert(truth, others[rng.integers(len(others))].photo)
        return Trial(grasp, tuple(shown), truth + 1)

    def model_choice(self, generation: ServedGeneration, trial: Trial) -> int:
        """What the model chooses in the same trial, counted from 1: the photo of largest match logit."""
        background = generation.searcher.checkpoint.config.preprocessing.background
        reference = trial.grasp.backgrounds if background != "none" else None
        partials = generation.searcher.encode([trial.grasp.touches], background=reference).partials
        photos = embed_photos(trial.photos, model=generation.checkpoint()).partials
        return int(generation.searcher.scorer.logits(partials, photos).argmax()) + 1
