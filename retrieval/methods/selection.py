"""How a method chooses its settings: by ranking on objects held out of its fit, never by the fit itself."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import NumericalError
from retrieval.metrics.measure import weight_below
from retrieval.training.features import Features

MAX_VALIDATION_ROWS = 512


def validation_rows(validation: Features, most: int = MAX_VALIDATION_ROWS) -> NDArray[np.int64]:
    """Rows of the grasps to choose by: of each object as many, evenly spaced, about `most` in all (2 at least)."""
    each = max(most // (int(validation.owner.max()) + 1), 2)
    parts = [np.flatnonzero(validation.owner == owner) for owner in range(int(validation.owner.max()) + 1)]
    return np.concatenate([part[np.linspace(0, len(part) - 1, min(each, len(part))).astype(int)] for part in parts])


def ranking_auc(
    scores: NDArray[np.floating[Any]],
    touch_owner: NDArray[np.int64],
    photo_owner: NDArray[np.int64],
    left_out: NDArray[np.bool_],
) -> float:
    """How often a photo of the touched object scores above one of another object; equals count half.

    scores (T, N); left_out (T, N): photos taken in the row's own grasps, which do not count (where the object has no
    other, they do). Mean over the pairs of a touch, over the touches of an object, over objects; a constant scorer
    has exactly 0.5. Raises NumericalError for a score that is not finite: in a count of what is higher a NaN is a loss.
    """
    bad = np.flatnonzero(~np.isfinite(scores).all(axis=1))
    if len(bad):
        raise NumericalError(f"every score must be finite; touch {bad[0]} has a NaN or infinite one")
    values = np.empty(len(scores))
    for row, (score, owner) in enumerate(zip(scores, touch_owner, strict=True)):
        same = photo_owner == owner
        own = same & ~left_out[row]
        others = score[~same]
        values[row] = weight_below(score[own if own.any() else same], others).mean() / len(others)
    return float(np.mean([values[touch_owner == owner].mean() for owner in np.unique(touch_owner)]))


@dataclass(frozen=True, eq=False)
class Validator:
    """The validation grasps to choose by; both methods give the area that the scores of their touches are worth."""

    features: Features

    @classmethod
    def of(cls, validation: Features) -> "Validator":
        """A validator by as many of the validation grasps as are enough."""
        return cls(validation.select(validation_rows(validation)))

    def touch_auc(self, scores: NDArray[np.floating[Any]]) -> float:
        """Worth of scores (n, n) of every touch with every photo."""
        return self.set_auc(scores, np.arange(len(self.features))[:, None])

    def set_auc(self, scores: NDArray[np.floating[Any]], sets: NDArray[np.int64]) -> float:
        """Worth of scores (S, n) of sets (S, G) of touches with every photo."""
        left_out = np.zeros(scores.shape, dtype=np.bool_)
        np.put_along_axis(left_out, sets, True, axis=1)
        owner = self.features.owner
        return ranking_auc(scores, owner[sets[:, 0]], owner, left_out)


def next_rows_of_object(owner: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """(n, most) for each row itself and the next rows of its object, round."""
    groups = np.empty((len(owner), most), dtype=np.int64)
    for name in np.unique(owner):
        rows = np.flatnonzero(owner == name)
        groups[rows] = rows[(np.arange(len(rows))[:, None] + np.arange(most)) % len(rows)]
    return groups


MIN_OBJECTS_FOR_FOUR_FOLDS = 12
"""Objects that four folds need, three in each; fewer make two folds."""


def held_out_folds(
    features: Features,
    kind_of: Mapping[str, str] | None = None,
    linked: Iterable[Sequence[str]] = (),
    seed: int = 0,
) -> list[tuple[str, ...]]:
    """The objects in four folds, or two: of each kind every second object stands in one fold, the others in another.

    A held-out object, all of whose look-alikes train, is told more easily than one that a user adds tomorrow. So half
    of the objects of a kind are held out together, while the other half trains.

    kind_of: the kind of each object, where the recording names it; otherwise objects that look alike are of one kind
    (`appearance_order`). linked: objects that stay together, such as those of one sequence.
    """
    names = sorted(set(features.object_ids))
    if kind_of is not None and all(name in kind_of for name in names):
        shuffled = [names[place] for place in np.random.default_rng([seed, 29]).permutation(len(names))]
        order = sorted(shuffled, key=lambda name: kind_of[name])
    else:
        order = appearance_order(features)
    unit_of = {name: tuple(each for each in sorted(unit) if each in names) for unit in linked for name in unit}
    sides: list[list[str]] = [[], []]
    for unit in dict.fromkeys(unit_of.get(name, (name,)) for name in order):
        min(sides, key=len).extend(unit)
    if len(names) < MIN_OBJECTS_FOR_FOUR_FOLDS or any(len(unit) > 1 for unit in unit_of.values()):
        return [tuple(sorted(side)) for side in sides]
    return [tuple(sorted(part.tolist())) for side in sides for part in np.array_split(side, 2)]


def appearance_order(features: Features) -> list[str]:
    """The objects in an order in which neighbours look alike: leaves of average linkage, in optimal order (Bar-Joseph,
    Gifford and Jaakkola 2001), of the mean photo features of each object, standardised over the objects.
    """
    from scipy.cluster.hierarchy import leaves_list, linkage  # slow to import

    names, owner = sorted(set(features.object_ids)), features.owner
    if len(names) < 3:
        return names
    means = np.stack([features.photo[owner == place].mean(0, dtype=np.float64) for place in range(len(names))])
    spread = means.std(0)
    shown = (means - means.mean(0))[:, spread > 0] / spread[spread > 0]
    shown = shown / np.maximum(np.linalg.norm(shown, axis=1, keepdims=True), 1e-12)
    return [names[place] for place in leaves_list(linkage(shown, "average", optimal_ordering=True))]
