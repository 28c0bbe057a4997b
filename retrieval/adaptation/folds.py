"""What a fit is worth on objects that it never saw: own objects are few, so each is left out once."""

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
from retrieval.metrics.k_way import k_way_accuracies
from retrieval.metrics.measure import Measure, pooled
from retrieval.training.features import Features

GALLERY = 9
"""Objects among which a held-out touch is told, at most: about as many as a fold holds."""
MIN_OBJECTS = 6
"""Own objects that can be judged: two folds of three."""


@dataclass(frozen=True, eq=False)
class Fold:
    """Objects that are left out together, the features of their grasps, and the codes that the others taught, with
    settings that were chosen among these others.
    """

    left_out: Features
    projections: CcaProjections
    settings: CcaSettings

    def cosines(self) -> NDArray[np.float32]:
        """(n, n) of the touch of every grasp left out with the photo of every such grasp."""
        return self.projections.cosines(self.left_out.touch.reshape(len(self.left_out), -1), self.left_out.photo)


def draw_folds(grasps: Sequence[Grasp], seed: int) -> list[tuple[str, ...]]:
    """Objects in folds of about `GALLERY`; objects that share a sequence stay together. Raises BadInput for fewer
    than `MIN_OBJECTS` objects.
    """
    groups = linked_objects(grasps)
    total = sum(map(len, groups))
    if total < MIN_OBJECTS:
        raise BadInput(f"{MIN_OBJECTS} objects or more can be judged by leaving each out once; got {total}")
    folds: list[list[str]] = [[] for _ in range(min(max(round(total / GALLERY), 2), total // 3))]
    for place in np.random.default_rng([seed, 7]).permutation(len(groups)):
        min(folds, key=len).extend(groups[place])
    return [tuple(sorted(fold)) for fold in folds]


def fit_folds(
    features: Features, folds: Sequence[Sequence[str]], data: AdaptationData, *, seed: int, label: str, quiet: bool
) -> Iterator[Fold]:
    """Each fold, and what the objects outside it teach: settings, too, are chosen among these alone."""
    everyone = {name for fold in folds for name in fold}
    with Bar(f"judge {label}", len(folds), "folds", quiet=quiet) as bar:
        for fold in folds:
            choice = choose_settings(features.of_objects(everyone.difference(fold)), data, seed)
            yield Fold(features.of_objects(fold), choice.projections, choice.settings)
            bar.advance()


def choose_settings(features: Features, data: AdaptationData, seed: int) -> CcaSelection:
    """Settings chosen by holding out half of each kind of these objects, and the codes that all of them teach."""
    parts = held_out_folds(features, data.kind_of, linked_objects(data.grasps), seed)
    return select_settings(features, data.blocks, parts)


@dataclass(frozen=True, eq=False)
class FoldAccuracy:
    """How each touch of a fold (n of them) was told apart from the fold's other objects.

    object_ids (n,): what was touched. first (n,): whether its own object's photo stood first (a share where photos
    tie). below (n,): the share of the other objects' photos that stood lower, equals counting half. objects: how many
    were told apart.
    """

    object_ids: tuple[str, ...]
    top1: NDArray[np.float64]
    pair_accuracy: NDArray[np.float64]
    objects: int

    def measure(self, column: str) -> Measure:
        """The measure "first" or "below", of objects by their place in the alphabet."""
        owner = np.unique(self.object_ids, return_inverse=True)[1].astype(np.int64)
        chance = 1 / self.objects if column == "top1" else 0.5
        return Measure(getattr(self, column)[:, None], owner, np.array([chance]), f"{self.objects} objects left out")


def fold_accuracy(fold: Fold, seed: int = 0) -> FoldAccuracy:
    """Tell each touch of a fold by one photo, drawn, of each of the fold's objects; the photo of its own object is of
    another grasp where there is one.
    """
    return score_accuracy(fold.cosines(), fold.left_out, seed)


def score_accuracy(scores: NDArray[np.float32], features: Features, seed: int = 0) -> FoldAccuracy:
    """As `fold_accuracy`, from scores (n, n) of every touch with the photo of every grasp."""
    rng, owner = np.random.default_rng([seed, 8]), features.owner
    rows = [np.flatnonzero(owner == name) for name in range(owner.max() + 1)]
    higher, equal = np.empty((2, len(features)), np.int64)
    for touch, name in enumerate(owner):
        shown = np.array([rng.choice(mine[mine != touch] if len(mine) > 1 else mine) for mine in rows])
        own, others = scores[touch, shown[name]], np.delete(scores[touch, shown], name)
        higher[touch], equal[touch] = (others > own).sum(), (others == own).sum()
    rivals = len(rows) - 1
    top1 = k_way_accuracies(higher, equal, rivals, len(rows))[:, 0]
    return FoldAccuracy(features.object_ids, top1, 1 - (higher + equal / 2) / rivals, len(rows))


def pair_accuracy(parts: Sequence[FoldAccuracy]) -> float:
    """How often a touch's own photo stands above one of another object; objects count alike."""
    return float(measure(parts, "pair_accuracy").by_object()[1].mean())


def measure(parts: Sequence[FoldAccuracy], column: str) -> Measure:
    """The measure "first" or "below" of all folds."""
    names = [sorted(set(part.object_ids)) for part in parts]
    number_of = {name: number for number, name in enumerate(sorted(set().union(*names)))}
    units = [{place: number_of[name] for place, name in enumerate(own)} for own in names]
    found = pooled([part.measure(column) for part in parts], units)
    sizes = sorted({part.objects for part in parts})
    return replace(found, gallery=" or ".join(map(str, sizes)) + " objects left out, one photo of each")
