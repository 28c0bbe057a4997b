"""How a method chooses its settings: by ranking on validation objects, never by its fit to the training objects."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import NumericalError
from retrieval.metrics.auc import weight_below
from retrieval.training.features import Features

MOST_JUDGED = 512


def judged_rows(validation: Features, most: int = MOST_JUDGED) -> NDArray[np.int64]:
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
        return cls(validation.select(judged_rows(validation)))

    def touches(self, scores: NDArray[np.floating[Any]]) -> float:
        """Worth of scores (n, n) of every touch with every photo."""
        return self.sets(scores, np.arange(len(self.features))[:, None])

    def sets(self, scores: NDArray[np.floating[Any]], sets: NDArray[np.int64]) -> float:
        """Worth of scores (S, n) of sets (S, G) of touches with every photo."""
        left_out = np.zeros(scores.shape, dtype=np.bool_)
        np.put_along_axis(left_out, sets, True, axis=1)
        owner = self.features.owner
        return ranking_auc(scores, owner[sets[:, 0]], owner, left_out)


def neighbours(owner: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """(n, most) for each row itself and the next rows of its object, round."""
    groups = np.empty((len(owner), most), dtype=np.int64)
    for name in np.unique(owner):
        rows = np.flatnonzero(owner == name)
        groups[rows] = rows[(np.arange(len(rows))[:, None] + np.arange(most)) % len(rows)]
    return groups
