"""What metrics are taken of: a table of scores with its owners, and scores of objects drawn from it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput, NumericalError
from retrieval.metrics.ranking import FirstRelevant, first_relevant


@dataclass(frozen=True, eq=False)
class ScoreTable:
    """Scores of touches (rows; a row may be a set of grasps) with photos (columns), and who is who.

    scores (T, N) floating, the higher the better; touch_owner (T,) and photo_owner (N,): numbers of the objects;
    own (T, N): the photo was taken in a grasp of that very row, so it is never shown to it (except where a protocol
    says so). object_words, row_words, column_words: what a reader is told the objects, rows and columns are.

    Raises BadInput for shapes that do not fit and an own photo of another object, NumericalError for a score that is
    not finite: sorted downwards, a NaN would stand first.
    """

    scores: NDArray[np.float32]
    touch_owner: NDArray[np.int64]
    photo_owner: NDArray[np.int64]
    own: NDArray[np.bool_]
    object_words: str = "objects"
    row_words: str = "touches"
    column_words: str = "photos"

    def __post_init__(self) -> None:
        shape = (len(self.touch_owner), len(self.photo_owner))
        if self.scores.shape != shape or self.own.shape != shape or self.own.dtype != bool or 0 in shape:
            raise BadInput(
                f"scores and own (bool) must have a row for each of the {shape[0]} touches and a column for each of "
                f"the {shape[1]} photos, and one at least; got {self.scores.shape} and {self.own.shape}"
            )
        bad = np.argwhere(~np.isfinite(self.scores))
        if len(bad):
            row, column = bad[0]
            raise NumericalError(
                f"every score must be finite; row {row}, column {column} is {self.scores[row, column]}"
            )
        if (self.own & ~self.relevant).any():
            raise BadInput("a photo of a row's own grasp must show the row's object; one shows another: check the ids")

    @cached_property
    def relevant(self) -> NDArray[np.bool_]:
        """(T, N): the photo shows the object of the row, own photos included."""
        return np.asarray(self.touch_owner[:, None] == self.photo_owner[None])

    @cached_property
    def has_target(self) -> NDArray[np.bool_]:
        """(T,): the row has a photo of its object to find that is not its own."""
        return np.asarray((self.relevant & ~self.own).any(1))

    @cached_property
    def with_targets(self) -> "ScoreTable":
        """The table of the rows that are has_target. Raises BadInput where none is."""
        if not self.has_target.any():
            raise BadInput(
                f"to be asked, {self.row_words} need {self.column_words} of their object from another grasp; none has "
                "any; record more grasps of each object"
            )
        return self if self.has_target.all() else self.select(self.has_target, np.arange(len(self.photo_owner)))

    @cached_property
    def gallery(self) -> str:
        """What was searched, as a reader is told it."""
        own = "those of the same grasp left out" if self.own.any() else "those of the same grasp included"
        words = f"{len(self.objects)} {self.object_words}, {len(self.photo_owner)} {self.column_words}; {own}"
        missing = np.count_nonzero(~self.has_target)
        return words + (f"; {missing} {self.row_words} not asked, which have no other" if missing else "")

    @cached_property
    def first(self) -> FirstRelevant:
        """Where the first photo of each row's object stands among all, own photos left out; every row is has_target."""
        return first_relevant(self.scores, self.relevant, ~self.own)

    @cached_property
    def objects(self) -> NDArray[np.int64]:
        """(O,) numbers of the objects that have photos, ascending."""
        return np.unique(self.photo_owner)

    @cached_property
    def min_photos(self) -> int:
        """The least number of photos that an asked row can be shown of any object, its own left out."""
        owners = np.unique(self.with_targets.photo_owner, return_counts=True)[1]
        return int(min(owners.min(), (self.with_targets.relevant & ~self.with_targets.own).sum(1).min()))

    def select(
        self, rows: NDArray[np.int64] | NDArray[np.bool_], columns: NDArray[np.int64] | NDArray[np.bool_]
    ) -> "ScoreTable":
        """The table of these rows and these columns, in the order given."""
        scores, own = self.scores[rows][:, columns], self.own[rows][:, columns]
        touch_owner, photo_owner = self.touch_owner[rows], self.photo_owner[columns]
        return replace(self, scores=scores, own=own, touch_owner=touch_owner, photo_owner=photo_owner)

    def transposed(self) -> "ScoreTable":
        """Photos ask, touches are the gallery."""
        return ScoreTable(
            self.scores.T, self.photo_owner, self.touch_owner, self.own.T,
            self.object_words, self.column_words, self.row_words,
        )  # fmt: skip

    def with_own(self) -> "ScoreTable":
        """The table of a protocol that shows a row its own photos too."""
        return replace(self, own=np.zeros_like(self.own))


Pooling = Callable[[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]
"""Scores of shown photos (P,), the row of each (P,) and their number by row (T,) to the rows' scores (T,)."""


def object_scores(
    table: ScoreTable, photos: int, draws: int, seed: int, pool: Pooling | None = None
) -> NDArray[np.float64]:
    """Scores (draws, T, O) of rows with objects, each shown by `photos` photos drawn without replacement.

    Their mean, or what `pool` makes of them, such as a posterior's logit of the object (`Posterior.object_logits`).
    Columns stand in the order of `table.objects`. Own photos are never drawn; an object with fewer photos shows all
    that it has. What is drawn hangs on the seed and on who owns what, never on scores, so that methods are asked the
    same. Raises BadInput where a row's own object has no photo left to show: leave such rows out first.
    """
    if not (table.has_target | ~table.relevant.any(1)).all():
        raise BadInput("every row must leave its object a photo to show; one has none but its own: leave the row out")
    rng = np.random.default_rng([seed, photos])
    found = np.empty((draws, len(table.touch_owner), len(table.objects)))
    for draw in range(draws):
        for place, name in enumerate(table.objects):
            columns = rng.permutation(np.flatnonzero(table.photo_owner == name))
            mine = np.flatnonzero(table.touch_owner == name)
            found[draw, :, place] = _of_photos(*_window(table.scores, columns, photos, rng), pool)
            found[draw, mine, place] = _of_photos(*_without_own(table, mine, columns, photos, rng), pool)
    return found


ShownScores = tuple[NDArray[np.float64], NDArray[np.bool_]]
"""Scores (T, p) of rows with photos of one object, and which of these are shown to them."""


def _window(
    scores: NDArray[np.float32], columns: NDArray[np.int64], photos: int, rng: np.random.Generator
) -> ShownScores:
    """Every row sees a window of its own over the shuffled columns: without replacement, and cheap."""
    start = rng.integers(len(columns), size=len(scores))
    window = (start[:, None] + np.arange(min(photos, len(columns)))) % len(columns)
    found = scores[np.arange(len(scores))[:, None], columns[window]].astype(np.float64)
    return found, np.ones(found.shape, dtype=bool)


def _without_own(
    table: ScoreTable, mine: NDArray[np.int64], columns: NDArray[np.int64], photos: int, rng: np.random.Generator
) -> ShownScores:
    """The object's own rows: a random order of the photos for each, its own ones last and never counted."""
    own, scores = table.own[mine][:, columns], table.scores[mine][:, columns].astype(np.float64)
    order = np.argsort(rng.random(own.shape) + own, axis=1)[:, :photos]
    return np.take_along_axis(scores, order, 1), ~np.take_along_axis(own, order, 1)


def _of_photos(scores: NDArray[np.float64], shown: NDArray[np.bool_], pool: Pooling | None) -> NDArray[np.float64]:
    """(T,) from the photos that each row is shown."""
    if pool is None:
        return np.asarray((scores * shown).sum(1) / shown.sum(1))
    return pool(scores[shown], np.nonzero(shown)[0], shown.sum(1))
