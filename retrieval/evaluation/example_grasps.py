"""Example queries that illustrate the numbers of results.json."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.metrics import protocols
from retrieval.metrics.table import ScoreTable

_EXAMPLES, _RANKED = 6, 6


def example_queries(
    table: ScoreTable,
    objects: Sequence[str],
    touch_ids: Sequence[str],
    photo_ids: Sequence[str],
    *,
    one_of_each: bool = False,
) -> dict[str, list[dict[str, Any]]]:
    """Return the best and the worst queries, at most one of each object.

    Queries are ordered by the rank of their first true photo, then by the margin to the best false photo.

    Args:
        table: Scores of touches (rows) with photos (columns).
        objects: Object names by number.
        touch_ids: Grasp ids of the rows.
        photo_ids: Grasp ids of the columns.
        one_of_each: List only the best photo of each object that a query finds.

    Returns:
        {"best": queries, "worst": queries}.
    """
    ranks, scores = protocols.true_ranks(table), np.where(table.own, -np.inf, table.scores)
    true, false = (np.where(among, scores, -np.inf).max(1) for among in (table.relevant, ~table.relevant))
    order = [row for row in np.lexsort((false - true, ranks)).tolist() if table.has_target[row]]

    def example(row: int) -> dict[str, Any]:
        columns = np.argsort(-scores[row], kind="stable").tolist()
        if one_of_each:
            columns = _one_each(columns, table.photo_owner)
        return {
            "grasp_id": touch_ids[row],
            "object_id": objects[table.touch_owner[row]],
            "true_rank": float(ranks[row]),
            "ranked": [photo_ids[column] for column in columns[:_RANKED]],
        }

    first, last = (_one_each(rows, table.touch_owner)[:_EXAMPLES] for rows in (order, order[::-1]))
    return {"best": [example(row) for row in first], "worst": [example(row) for row in last]}


def _one_each(rows: Sequence[int], owner: NDArray[np.int64]) -> list[int]:
    """Return the first row of each object."""
    first: dict[int, int] = {}
    for row in rows:
        first.setdefault(int(owner[row]), int(row))
    return list(first.values())
