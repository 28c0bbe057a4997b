"""What a fit is worth on objects that it never saw: own objects are few, so each is left out once."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from retrieval.adaptation.material import Material
from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp, linked_objects
from retrieval.errors import BadInput
from retrieval.methods.cca_towers import CcaSettings, Choice, Codes, choose
from retrieval.methods.selection import held_out_folds
from retrieval.metrics.guesses import guess_curves
from retrieval.metrics.measure import Measure, pooled
from retrieval.training.features import Features

GALLERY = 9
"""Objects among which a held-out touch is told, at most: about as many as a fold holds."""
FEWEST = 6
"""Own objects that can be judged: two folds of three."""


@dataclass(frozen=True, eq=False)
class Fold:
    """Objects that are left out together, the features of their grasps, and the codes that the others taught, with
    settings that were chosen among these others."""

    left_out: Features
    codes: Codes
    settings: CcaSettings

    def cosines(self) -> NDArray[np.float32]:
        """(n, n) of the touch of every grasp left out with the photo of every such grasp."""
        return self.codes.cosines(self.left_out.touch.reshape(len(self.left_out), -1), self.left_out.photo)


def draw_folds(grasps: Sequence[Grasp], seed: int) -> list[tuple[str, ...]]:
    """Objects in folds of about `GALLERY`; objects that share a sequence stay together. Raises BadInput for fewer
    than `FEWEST` objects."""
    groups = linked_objects(grasps)
    total = sum(map(len, groups))
    if total < FEWEST:
        raise BadInput(f"{FEWEST} objects or more can be judged by leaving each out once; got {total}")
    folds: list[list[str]] = [[] for _ in range(min(max(round(total / GALLERY), 2), total // 3))]
    for place in np.random.default_rng([seed, 7]).permutation(len(groups)):
        min(folds, key=len).extend(groups[place])
    return [tuple(sorted(fold)) for fold in folds]


def fit_folds(
    features: Features, folds: Sequence[Sequence[str]], material: Material, *, seed: int, what: str, quiet: bool
) -> Iterator[Fold]:
    """Each fold, and what the objects outside it teach: settings, too, are chosen among these alone."""
    everyone = {name for fold in folds for name in fold}
    with Bar(f"judge {what}", len(folds), "folds", quiet=quiet) as bar:
        for fold in folds:
            choice = choose_settings(features.of_objects(everyone.difference(fold)), material, seed)
            yield Fold(features.of_objects(fold), choice.codes, choice.settings)
            bar.advance()


def choose_settings(features: Features, material: Material, seed: int) -> Choice:
    """Settings chosen by holding out half of each kind of these objects, and the codes that all of them teach."""
    parts = held_out_folds(features, material.kind_of, linked_objects(material.grasps), seed)
    return choose(features, material.blocks, parts)


@dataclass(frozen=True, eq=False)
class ToldApart:
    """How each touch of a fold (n of them) was told apart from the fold's other objects.

    object_ids (n,): what was touched. first (n,): whether its own object's photo stood first (a share where photos
    tie). below (n,): the share of the other objects' photos that stood lower, equals counting half. objects: how many
    were told apart.
    """

    object_ids: tuple[str, ...]
    first: NDArray[np.float64]
    below: NDArray[np.float64]
    objects: int

    def measure(self, column: str) -> Measure:
        """The measure "first" or "below", of objects by their place in the alphabet."""
        owner = np.unique(self.object_ids, return_inverse=True)[1].astype(np.int64)
        chance = 1 / self.objects if column == "first" else 0.5
        return Measure(getattr(self, column)[:, None], owner, np.array([chance]), f"{self.objects} objects left out")


def first_guesses(fold: Fold, seed: int = 0) -> ToldApart:
    """Tell each touch of a fold by one photo, drawn, of each of the fold's objects; the photo of its own object is of
    another grasp where there is one."""
    return tell_apart(fold.cosines(), fold.left_out, seed)


def tell_apart(scores: NDArray[np.float32], features: Features, seed: int = 0) -> ToldApart:
    """As `first_guesses`, from scores (n, n) of every touch with the photo of every grasp."""
    rng, owner = np.random.default_rng([seed, 8]), features.owner
    rows = [np.flatnonzero(owner == name) for name in range(owner.max() + 1)]
    higher, equal = np.empty((2, len(features)), np.int64)
    for touch, name in enumerate(owner):
        shown = np.array([rng.choice(mine[mine != touch] if len(mine) > 1 else mine) for mine in rows])
        own, others = scores[touch, shown[name]], np.delete(scores[touch, shown], name)
        higher[touch], equal[touch] = (others > own).sum(), (others == own).sum()
    rivals = len(rows) - 1
    first = guess_curves(higher, equal, rivals, len(rows))[:, 0]
    return ToldApart(features.object_ids, first, 1 - (higher + equal / 2) / rivals, len(rows))


def pair_accuracy(parts: Sequence[ToldApart]) -> float:
    """How often a touch's own photo stands above one of another object; objects count alike."""
    return float(measure(parts, "below").by_object()[1].mean())


def measure(parts: Sequence[ToldApart], column: str) -> Measure:
    """The measure "first" or "below" of all folds."""
    names = [sorted(set(part.object_ids)) for part in parts]
    number_of = {name: number for number, name in enumerate(sorted(set().union(*names)))}
    units = [{place: number_of[name] for place, name in enumerate(own)} for own in names]
    found = pooled([part.measure(column) for part in parts], units)
    sizes = sorted({part.objects for part in parts})
    return replace(found, gallery=" or ".join(map(str, sizes)) + " objects left out, one photo of each")
