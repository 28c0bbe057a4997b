"""Example grasps that illustrate the numbers of results.json."""

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
    """Scores of one method and seed, with the names that results.json uses.

    Attributes:
        table: Scores of touches (rows) with photos (columns).
        objects: Object names by number.
        touch_ids: Grasp ids of the rows.
        photo_ids: Grasp ids of the columns.
    """

    table: ScoreTable
    objects: Sequence[str]
    touch_ids: Sequence[str]
    photo_ids: Sequence[str]

    def examples(self, *, one_of_each: bool = False) -> dict[str, list[dict[str, Any]]]:
        """Return the best and the worst queries, at most one of each object.

        Queries are ordered by the rank of their first true photo, then by the margin to the best false photo.

        Args:
            one_of_each: List only the best photo of each object that a query finds.

        Returns:
            {"best": queries, "worst": queries}.
        """
        ranks, scores = protocols.true_ranks(self.table), self._scores_without_own()
        margin = self._best(self.table.relevant) - self._best(~self.table.relevant)
        order = [row for row in np.lexsort((-margin, ranks)) if self.table.has_target[row]]

        def example(row: int) -> dict[str, Any]:
            columns = np.argsort(-scores[row], kind="stable").tolist()
            if one_of_each:
                columns = _one_each(columns, self.table.photo_owner)
            return self._query(row) | {
                "true_rank": float(ranks[row]),
                "ranked": [self._photo(column) for column in columns[:_RANKED]],
            }

        first, last = (_one_each(rows, self.table.touch_owner)[:_EXAMPLES] for rows in (order, order[::-1]))
        return {"best": [example(row) for row in first], "worst": [example(row) for row in last]}

    def confusion_examples(self, true: int, predicted: int) -> list[dict[str, Any]]:
        """Return the touches of object `true` with the highest margin for `predicted`, each with its best photo."""
        of_other = np.broadcast_to(self.table.photo_owner == predicted, self.table.scores.shape)
        margin = self._best(of_other) - self._best(self.table.relevant)
        own = np.flatnonzero((self.table.touch_owner == true) & self.table.has_target)
        rows = own[np.argsort(-margin[own], kind="stable")][:_EACH]
        return [self._query(row) | {"found": self._photo(self._first(of_other, row))} for row in rows]

    def examples_by_rank(self, k: int, seed: int) -> list[list[dict[str, Any]]]:
        """Return for each rank 1..K the touches whose object most likely has that rank among K candidates.

        Args:
            k: Number of candidates.
            seed: Seed of the K-way test.

        Returns:
            For each rank the touches, at most one of each object, each with its best photo. Empty for fewer than K
            objects.
        """
        measure = k_way_measure(self.table, k, seed)
        if measure is None:
            return []
        queries, every = np.flatnonzero(self.table.has_target), np.ones_like(self.table.own)
        chances = np.diff(measure.values, axis=1, prepend=0.0)
        found = []
        for chance in chances.T:
            rows = [int(row) for row in np.argsort(-chance, kind="stable") if chance[row] > 0]
            found.append(
                [
                    self._query(row) | {"found": self._photo(self._first(every, row))}
                    for row in _one_each(queries[rows].tolist(), self.table.touch_owner)[:_EACH]
                ]
            )
        return found

    def _scores_without_own(self) -> NDArray[np.float32]:
        """Return the scores with -inf for the photo of a touch's own grasp."""
        return np.where(self.table.own, -np.inf, self.table.scores)

    def _best(self, among: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Return the highest score of each touch among these photos."""
        return np.asarray(np.where(among, self._scores_without_own(), -np.inf).max(1))

    def _first(self, among: NDArray[np.bool_], row: int) -> int:
        return int(np.where(among[row], self._scores_without_own()[row], -np.inf).argmax())

    def _query(self, row: int) -> dict[str, Any]:
        return {"grasp_id": self.touch_ids[row], "object_id": self.objects[self.table.touch_owner[row]]}

    def _photo(self, column: int) -> str:
        """Return the grasp of the photo."""
        return self.photo_ids[column]


def _one_each(rows: Sequence[int], owner: NDArray[np.int64]) -> list[int]:
    """Return the first row of each object."""
    first: dict[int, int] = {}
    for row in rows:
        first.setdefault(int(owner[row]), int(row))
    return list(first.values())
