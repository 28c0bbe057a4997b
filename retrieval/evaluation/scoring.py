"""Scores of one method and seed as tables for the metrics."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retrieval.evaluation.calibrate import pair_threshold
from retrieval.evaluation.predictions import Predictions
from retrieval.evaluation.queries import Queries
from retrieval.evaluation.results import PairThreshold
from retrieval.metrics.registry import MethodScoreTables
from retrieval.metrics.table import ScoreTable
from retrieval.training.calibration.touches import ScoredTouches


@dataclass(frozen=True, eq=False)
class MethodScores:
    """Scores of one method and seed, as tables for the metrics.

    Attributes:
        queries: The queries of the evaluation.
        predictions: The scores.
        seed: Seed of drawn tests and pairs.
        allows_own_photos: Whether a touch is compared with the photo of its own grasp.
    """

    queries: Queries
    predictions: Predictions
    seed: int
    allows_own_photos: bool = False

    def touches(self, rows: str | None, columns: str | None) -> ScoreTable:
        """Return the scores of touches with photos.

        Args:
            rows: Part of the touches; None for all parts.
            columns: Part of the photos; None for all parts.
        """
        queries = self.queries
        touches, photos = _of(queries, queries.touch_owner, rows), _of(queries, queries.photo_owner, columns)
        table = ScoreTable(
            scores=self.predictions.scores[np.ix_(touches, photos)],
            touch_owner=queries.touch_owner[touches],
            photo_owner=queries.photo_owner[photos],
            own=queries.own_photo[touches][:, None] == photos,
            object_words=f"{columns} objects" if columns else "objects of all parts",
        )
        return table.with_own() if self.allows_own_photos else table

    def sets(self, part: str) -> dict[int, ScoreTable]:
        """Return the scores of sets of grasps with photos of the same part, by number of grasps.

        Sizes without a set that has a target photo are left out.
        """
        tables = {size: self._sets(part, size) for size in self.queries.sets}
        found = {size: table for size, table in tables.items() if table is not None and table.has_target.any()}
        return {size: table.with_own() for size, table in found.items()} if self.allows_own_photos else found

    def _sets(self, part: str, size: int) -> ScoreTable | None:
        queries, sets = self.queries, self.queries.sets[size]
        owner = queries.touch_owner[sets[:, 0]]
        rows, photos = queries.of_part(owner, part), queries.of_part(queries.photo_owner, part)
        if not len(rows):
            return None
        return ScoreTable(
            scores=self.predictions.set_scores[size][np.ix_(rows, photos)],
            touch_owner=owner[rows],
            photo_owner=queries.photo_owner[photos],
            own=(queries.own_photo[sets[rows]][:, :, None] == photos).any(1),
            object_words=f"{part} objects",
            row_words="sets of grasps",
        )

    def by_grasps(self, part: str) -> dict[int, ScoreTable]:
        """Return the scores by number of grasps, for calibration: single touches, and sets of more grasps."""
        return {1: self.touches(part, part)} | {size: table for size, table in self.sets(part).items() if size > 1}

    def score_tables(self) -> MethodScoreTables:
        """Return the tables that metrics need."""
        return MethodScoreTables(
            test=self.touches("test", "test"),
            all_objects=self.touches("test", None),
            sets=self.sets("test"),
            threshold=self.pair_threshold.at,
            seed=self.seed,
        )

    def scored_touches(self, part: str) -> ScoredTouches:
        """Return the scores of the touches with the photos of one part, as posteriors and verification take them."""
        table = self.touches(part, part)
        return ScoredTouches(table.scores, table.touch_owner, table.photo_owner, table.own)

    @cached_property
    def pair_threshold(self) -> PairThreshold:
        """Return the threshold that classifies a single touch and a photo as match or no match."""
        return pair_threshold(self.predictions.best_params, self.touches("validation", "validation"), seed=self.seed)


def _of(queries: Queries, owner: NDArray[np.int64], part: str | None) -> NDArray[np.int64]:
    return np.arange(len(owner)) if part is None else queries.of_part(owner, part)
