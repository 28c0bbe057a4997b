"""Cross-validation over the recorded objects: they are few, so each is left out once."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from retrieval.adaptation.data import AdaptationData
from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp, linked_objects
from retrieval.errors import BadInput
from retrieval.methods.cca_towers import CcaProjections, CcaSelection, CcaSettings, select_settings
from retrieval.methods.selection import held_out_folds
from retrieval.metrics.measure import Measure, pooled
from retrieval.metrics.ranking import k_way_accuracies
from retrieval.training.features import Features

GALLERY = 9
"""Approximate number of objects of a fold, which are the candidates of its touches."""
MIN_OBJECTS = 6
"""Minimum number of recorded objects: two folds of three."""


@dataclass(frozen=True, eq=False)
class Fold:
    """Objects that are left out together, and the fit to the other objects.

    Attributes:
        left_out: Features of the grasps of the held-out objects.
        projections: Projections fitted to the other objects.
        settings: Settings selected among the other objects.
    """

    left_out: Features
    projections: CcaProjections
    settings: CcaSettings

    def accuracy(self) -> "FoldAccuracy":
        """Return the accuracy of each touch of the held-out objects."""
        touches = self.left_out.touch.reshape(len(self.left_out), -1)
        return score_accuracy(self.projections.cosines(touches, self.left_out.photo), self.left_out)


def draw_folds(grasps: Sequence[Grasp], seed: int) -> list[tuple[str, ...]]:
    """Draw folds of about `GALLERY` objects; objects that share a sequence stay together.

    Raises:
        BadInput: There are fewer than `MIN_OBJECTS` objects.
    """
    groups = linked_objects(grasps)
    total = sum(map(len, groups))
    if total < MIN_OBJECTS:
        raise BadInput(f"Leaving each object out once needs at least {MIN_OBJECTS} objects, got {total}.")
    folds: list[list[str]] = [[] for _ in range(min(max(round(total / GALLERY), 2), total // 3))]
    for place in np.random.default_rng([seed, 7]).permutation(len(groups)):
        min(folds, key=len).extend(groups[place])
    return [tuple(sorted(fold)) for fold in folds]


def fit_folds(
    features: Features, folds: Sequence[Sequence[str]], data: AdaptationData, *, seed: int, label: str, quiet: bool
) -> Iterator[Fold]:
    """Yield each fold with the fit to the objects outside it. The settings are selected on the same objects."""
    everyone = {name for fold in folds for name in fold}
    with Bar(f"estimate, {label}", len(folds), "folds", quiet=quiet) as bar:
        for fold in folds:
            choice = choose_settings(features.of_objects(everyone.difference(fold)), data, seed)
            yield Fold(features.of_objects(fold), choice.projections, choice.settings)
            bar.advance()


def choose_settings(features: Features, data: AdaptationData, seed: int) -> CcaSelection:
    """Return settings, selected by holding out half of each kind of objects, and projections fitted to all objects."""
    parts = held_out_folds(features, data.kind_of, linked_objects(data.grasps), seed)
    return select_settings(features, data.blocks, parts)


@dataclass(frozen=True, eq=False)
class FoldAccuracy:
    """Accuracy of each touch of a fold among the objects of the fold.

    Attributes:
        object_ids: (n,) touched objects.
        top1: (n,) whether the photo of the touched object ranks first; 1/m if m photos tie.
        pair_accuracy: (n,) fraction of the other objects' photos with a lower score; ties count 1/2.
        objects: Number of candidate objects.
    """

    object_ids: tuple[str, ...]
    top1: NDArray[np.float64]
    pair_accuracy: NDArray[np.float64]
    objects: int

    def measure(self, column: str) -> Measure:
        """Return the measure "top1" or "pair_accuracy"; its owners are indices of the sorted objects."""
        owner = np.unique(self.object_ids, return_inverse=True)[1].astype(np.int64)
        chance = 1 / self.objects if column == "top1" else 0.5
        return Measure(getattr(self, column)[:, None], owner, np.array([chance]), f"{self.objects} held-out objects")


def score_accuracy(scores: NDArray[np.float32], features: Features) -> FoldAccuracy:
    """Return the accuracy of each touch with one random photo of each object, from scores (n, n) with every photo."""
    rng, owner = np.random.default_rng([0, 8]), features.owner
    rows = [np.flatnonzero(owner == name) for name in range(owner.max() + 1)]
    higher, equal = np.empty((2, len(features)), np.int64)
    for touch, name in enumerate(owner):
        drawn = np.array([rng.choice(mine[mine != touch] if len(mine) > 1 else mine) for mine in rows])
        own, others = scores[touch, drawn[name]], np.delete(scores[touch, drawn], name)
        higher[touch], equal[touch] = (others > own).sum(), (others == own).sum()
    rivals = len(rows) - 1
    top1 = k_way_accuracies(higher, equal, rivals, len(rows))[:, 0]
    return FoldAccuracy(features.object_ids, top1, 1 - (higher + equal / 2) / rivals, len(rows))


def measure(parts: Sequence[FoldAccuracy], column: str) -> Measure:
    """Return the measure "top1" or "pair_accuracy" of all folds."""
    names = [sorted(set(part.object_ids)) for part in parts]
    number_of = {name: number for number, name in enumerate(sorted(set().union(*names)))}
    units = [{place: number_of[name] for place, name in enumerate(own)} for own in names]
    found = pooled([part.measure(column) for part in parts], units)
    sizes = sorted({part.objects for part in parts})
    return replace(found, gallery=" or ".join(map(str, sizes)) + " held-out objects, one photo of each")
