"""Score tables with the objects of rows and columns, and object scores drawn from them."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput, NumericalError


@dataclass(frozen=True, eq=False)
class ScoreTable:
    """Scores of touches (rows; a row may be a set of grasps) with photos (columns).

    Attributes:
        scores: (T, N) floating, higher is better.
        touch_owner: (T,) object of each row.
        photo_owner: (N,) object of each column.
        own: (T, N) whether the photo was taken in a grasp of that row. The row's gallery excludes these photos, unless
            a protocol includes them.
        items: Noun for the columns in descriptions of the gallery.

    Raises:
        NumericalError: A score is not finite: in descending order a NaN would come first.
    """

    scores: NDArray[np.float32]
    touch_owner: NDArray[np.int64]
    photo_owner: NDArray[np.int64]
    own: NDArray[np.bool_]
    items: str = "photos"

    def __post_init__(self) -> None:
        bad = np.argwhere(~np.isfinite(self.scores))
        if len(bad):
            row, column = bad[0]
            raise NumericalError(
                f"every score must be finite; row {row}, column {column} is {self.scores[row, column]}"
            )

    @cached_property
    def relevant(self) -> NDArray[np.bool_]:
        """(T, N): whether the photo shows the object of the row, own photos included."""
        return np.asarray(self.touch_owner[:, None] == self.photo_owner[None])

    @cached_property
    def has_target(self) -> NDArray[np.bool_]:
        """(T,): whether the row has a photo of its object from another grasp."""
        return np.asarray((self.relevant & ~self.own).any(1))

    @cached_property
    def with_targets(self) -> "ScoreTable":
        """The table of the rows with `has_target`. Raises BadInput if there is none."""
        if not self.has_target.any():
            raise BadInput(
                f"queries need {self.items} of their object from another grasp; none has any; record more grasps of "
                "each object"
            )
        return self if self.has_target.all() else self.select(self.has_target, np.arange(len(self.photo_owner)))

    @cached_property
    def gallery(self) -> str:
        """Description of the searched items."""
        own = "those of the same grasp left out" if self.own.any() else "none left out"
        words = f"{len(self.objects)} objects, {len(self.photo_owner)} {self.items}; {own}"
        missing = np.count_nonzero(~self.has_target)
        return words + (f"; {missing} queries left out, which have no other" if missing else "")

    @cached_property
    def objects(self) -> NDArray[np.int64]:
        """(O,) numbers of the objects that have photos, ascending."""
        return np.unique(self.photo_owner)

    def select(
        self, rows: NDArray[np.int64] | NDArray[np.bool_], columns: NDArray[np.int64] | NDArray[np.bool_]
    ) -> "ScoreTable":
        """Return the table of these rows and columns, in the given order."""
        scores, own = self.scores[rows][:, columns], self.own[rows][:, columns]
        touch_owner, photo_owner = self.touch_owner[rows], self.photo_owner[columns]
        return replace(self, scores=scores, own=own, touch_owner=touch_owner, photo_owner=photo_owner)

    def transposed(self) -> "ScoreTable":
        """Return the table with photos as queries and touches as gallery."""
        return ScoreTable(self.scores.T, self.photo_owner, self.touch_owner, self.own.T, "touches")

    def with_own(self) -> "ScoreTable":
        """Return the table for a protocol whose galleries include a row's own photos."""
        return replace(self, own=np.zeros_like(self.own))


def object_scores(table: ScoreTable, photos: int, draws: int, seed: int) -> NDArray[np.float64]:
    """Return mean scores (draws, T, O) of rows of `with_targets` with photos of `table.objects`.

    Each object is represented by photos that are drawn without replacement, never a row's own; an object with fewer
    photos uses all of them. The draws depend on the seed and on the owners, never on scores, so all methods get the
    same queries.
    """
    rng = np.random.default_rng([seed, photos])
    found = np.empty((draws, len(table.touch_owner), len(table.objects)))
    for draw in range(draws):
        for place, name in enumerate(table.objects):
            columns = rng.permutation(np.flatnonzero(table.photo_owner == name))
            mine = np.flatnonzero(table.touch_owner == name)
            found[draw, :, place] = _window_means(table.scores, columns, photos, rng)
            found[draw, mine, place] = _means_without_own(table, mine, columns, photos, rng)
    return found


def _window_means(
    scores: NDArray[np.float32], columns: NDArray[np.int64], photos: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Give every row its own window over the shuffled columns: sampling without replacement at low cost."""
    start = rng.integers(len(columns), size=len(scores))
    window = (start[:, None] + np.arange(min(photos, len(columns)))) % len(columns)
    return np.asarray(scores[np.arange(len(scores))[:, None], columns[window]].mean(1, dtype=np.float64))


def _means_without_own(
    table: ScoreTable, mine: NDArray[np.int64], columns: NDArray[np.int64], photos: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draw photos for the object's own rows: in a random order per row, its own ones last and not in the mean."""
    own, scores = table.own[mine][:, columns], table.scores[mine][:, columns].astype(np.float64)
    order = np.argsort(rng.random(own.shape) + own, axis=1)[:, :photos]
    in_gallery = ~np.take_along_axis(own, order, 1)
    return np.asarray((np.take_along_axis(scores, order, 1) * in_gallery).sum(1) / in_gallery.sum(1))
