"""Which grasps stand for a number of results.json: a few, for the reader who asks to see some."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.metrics import protocols
from retrieval.metrics.registry import k_way_measure
from retrieval.metrics.table import ScoreTable

_EXAMPLES, _RANKED, _EACH = 6, 6, 4


@dataclass(frozen=True, eq=False)
class ExampleGrasps:
    """The touches of one method and seed with photos, and what they are called in results.json.

    objects: names by number; touch_ids, photo_ids: the grasps of the table's rows and columns.
    """

    table: ScoreTable
    objects: Sequence[str]
    touch_ids: Sequence[str]
    photo_ids: Sequence[str]

    def examples(self, *, one_of_each: bool = False) -> dict[str, list[dict[str, Any]]]:
        """The best and the worst queries, one of an object: by the rank of its first photo, then by the margin.

        one_of_each: of every object that is found, its best photo alone.
        """
        ranks, seen = protocols.true_ranks(self.table), self._scores_without_own()
        margin = self._best(self.table.relevant) - self._best(~self.table.relevant)
        order = [row for row in np.lexsort((-margin, ranks)) if self.table.has_target[row]]

        def example(row: int) -> dict[str, Any]:
            columns = np.argsort(-seen[row], kind="stable").tolist()
            if one_of_each:
                columns = _one_each(columns, self.table.photo_owner)
            return self._query(row) | {
                "true_rank": float(ranks[row]),
                "ranked": [self._photo(column) for column in columns[:_RANKED]],
            }

        first, last = (_one_each(rows, self.table.touch_owner)[:_EXAMPLES] for rows in (order, order[::-1]))
        return {"best": [example(row) for row in first], "worst": [example(row) for row in last]}

    def confusion_examples(self, true: int, guessed: int) -> list[dict[str, Any]]:
        """Touches of an object that speak most for another one, each with the photo that does."""
        of_other = np.broadcast_to(self.table.photo_owner == guessed, self.table.scores.shape)
        margin = self._best(of_other) - self._best(self.table.relevant)
        own = np.flatnonzero((self.table.touch_owner == true) & self.table.has_target)
        rows = own[np.argsort(-margin[own], kind="stable")][:_EACH]
        return [self._query(row) | {"found": self._photo(self._first(of_other, row))} for row in rows]

    def guessed(self, k: int, seed: int) -> list[list[dict[str, Any]]]:
        """For the Nth guess of K: the touches whose object is likeliest found by that guess and no earlier one, one of
        an object, each with the photo that comes first of all. Empty for fewer than K objects.
        """
        measure = k_way_measure(self.table, k, seed)
        if measure is None:
            return []
        asked, every = np.flatnonzero(self.table.has_target), np.ones_like(self.table.own)
        chances = np.diff(measure.values, axis=1, prepend=0.0)
        found = []
        for chance in chances.T:
            rows = [int(row) for row in np.argsort(-chance, kind="stable") if chance[row] > 0]
            found.append(
                [
                    self._query(row) | {"found": self._photo(self._first(every, row))}
                    for row in _one_each(asked[rows].tolist(), self.table.touch_owner)[:_EACH]
                ]
            )
        return found

    def _scores_without_own(self) -> NDArray[np.float32]:
        """Scores with -inf where a touch is not shown the photo: that of its own grasp."""
        return np.where(self.table.own, -np.inf, self.table.scores)

    def _best(self, among: NDArray[np.bool_]) -> NDArray[np.float32]:
        """For each touch the highest score among these photos."""
        return np.asarray(np.where(among, self._scores_without_own(), -np.inf).max(1))

    def _first(self, among: NDArray[np.bool_], row: int) -> int:
        return int(np.where(among[row], self._scores_without_own()[row], -np.inf).argmax())

    def _query(self, row: int) -> dict[str, Any]:
        return {"grasp_id": self.touch_ids[row], "object_id": self.objects[self.table.touch_owner[row]]}

    def _photo(self, column: int) -> str:
        """The grasp in which it was taken."""
        return self.photo_ids[column]


def _one_each(rows: Sequence[int], owner: NDArray[np.int64]) -> list[int]:
    """The first row of each object."""
    first: dict[int, int] = {}
    for row in rows:
        first.setdefault(int(owner[row]), int(row))
    return list(first.values())
