"""Scores of a fitted method for all queries of an evaluation, and their tables for the metrics."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.evaluation.calibration import fit_posterior
from retrieval.evaluation.queries import Queries
from retrieval.evaluation.results import PairThreshold
from retrieval.methods.method import Method, sum_over_sets
from retrieval.metrics.registry import MethodScoreTables
from retrieval.metrics.table import ScoreTable
from retrieval.model.encode import one_thread
from retrieval.model.posterior import Posterior
from retrieval.training.calibration.touches import ScoredTouches
from retrieval.training.features import Features

MIN_THRESHOLD_OBJECTS = 10
"""Minimum number of validation objects of a fitted pair threshold."""
_QUERY_REPEATS = 5


@dataclass(frozen=True, eq=False)
class MethodScores:
    """Scores of one fitted method.

    Attributes:
        queries: The queries.
        scores: (Q, P) of touches with photos.
        set_scores: By number of grasps, (S, P) of sets of grasps with photos.
        best_params: Parameters that the method selected on validation objects.
        seconds: Run times; no result depends on them.
        seed: Seed of drawn tests and pairs.
        allows_own_photos: Whether a touch is compared with the photo of its own grasp.
    """

    queries: Queries
    scores: NDArray[np.float32]
    set_scores: dict[int, NDArray[np.float32]]
    best_params: dict[str, Any]
    seconds: dict[str, float]
    seed: int
    allows_own_photos: bool = False

    def touches(self, rows: str | None, columns: str | None) -> ScoreTable:
        """Return the scores of the touches of one part of the objects with the photos of one part; None for all."""
        queries = self.queries
        touches, photos = queries.of_part(queries.touch_owner, rows), queries.of_part(queries.photo_owner, columns)
        own = queries.own_photo[touches][:, None] == photos
        words = f"{columns} objects" if columns else "objects of all parts"
        return self._table(self.scores, touches, queries.touch_owner, photos, own, words, "touches")

    def sets(self, part: str) -> dict[int, ScoreTable]:
        """Return the scores of sets of grasps with photos of the same part, by number of grasps.

        Sizes without a set that has a target photo are left out.
        """
        queries, found = self.queries, {}
        photos = queries.of_part(queries.photo_owner, part)
        for size, sets in queries.sets.items():
            owner = queries.touch_owner[sets[:, 0]]
            rows = queries.of_part(owner, part)
            own = (queries.own_photo[sets[rows]][:, :, None] == photos).any(1)
            if ((owner[rows][:, None] == queries.photo_owner[photos]) & ~own).any():
                scores = self.set_scores[size]
                found[size] = self._table(scores, rows, owner, photos, own, f"{part} objects", "sets of grasps")
        return found

    def _table(
        self,
        scores: NDArray[np.float32],
        rows: NDArray[np.int64],
        owner: NDArray[np.int64],
        photos: NDArray[np.int64],
        own: NDArray[np.bool_],
        object_words: str,
        row_words: str,
    ) -> ScoreTable:
        chosen, photo_owner = scores[np.ix_(rows, photos)], self.queries.photo_owner[photos]
        table = ScoreTable(chosen, owner[rows], photo_owner, own, object_words, row_words)
        return table.with_own() if self.allows_own_photos else table

    def tables(self, with_threshold: bool) -> MethodScoreTables:
        """Return the tables that metrics need; the pair threshold only if a metric uses it."""
        return MethodScoreTables(
            test=self.touches("test", "test"),
            all_objects=self.touches("test", None),
            sets=self.sets("test"),
            threshold=self.pair_threshold.at if with_threshold else None,
            seed=self.seed,
        )

    def scored_touches(self, part: str) -> ScoredTouches:
        """Return the scores of the touches with the photos of one part, as posteriors and verification take them."""
        table = self.touches(part, part)
        return ScoredTouches(table.scores, table.touch_owner, table.photo_owner, table.own)

    @cached_property
    def posterior(self) -> Posterior | None:
        """The posterior of single touches, fitted on validation objects; None for too few of them."""
        return fit_posterior(self.touches("validation", "validation"), self.seed)

    @cached_property
    def pair_threshold(self) -> PairThreshold:
        """The score at which a match and no match are equally likely, of the checkpoint or of `posterior`.

        Fewer than `MIN_THRESHOLD_OBJECTS` validation objects give none, because one for so few objects is arbitrary.
        """
        if (own := self.best_params.get("pair_threshold")) is not None:
            return PairThreshold(own, "the checkpoint")
        count = len(self.touches("validation", "validation").with_targets.objects)
        if count >= MIN_THRESHOLD_OBJECTS and self.posterior:
            return PairThreshold(self.posterior.threshold, "validation objects")
        needs = f"a threshold of the checkpoint, or one fitted on at least {MIN_THRESHOLD_OBJECTS} validation objects"
        return PairThreshold(None, None, f"pair accuracy needs {needs}; the split has {count}")


@one_thread()
def score_queries(
    method: Method,
    features: Features,
    queries: Queries,
    *,
    fit_s: float = 0.0,
    seed: int = 0,
    allows_own_photos: bool = False,
) -> MethodScores:
    """Score all queries with a fitted method, on one thread.

    Args:
        method: The fitted method.
        features: Tower features of all grasps.
        queries: Touches and photos to score.
        fit_s: Seconds that fitting took.
        seed: Seed of drawn tests and pairs.
        allows_own_photos: Whether a touch is compared with the photo of its own grasp.
    """
    touch, photo = features.touch[queries.touches], features.photo[queries.photos]
    touch_encodings, touch_s = _timed(lambda: method.encode_touch(touch))
    photo_encodings, photo_s = _timed(lambda: method.encode_photo(photo))
    scores, score_s = _timed(lambda: method.score(touch_encodings, photo_encodings))
    if type(method)._score_sets is Method._score_sets:  # the sum of single scores, which are computed
        sets = {size: sum_over_sets(scores, rows) for size, rows in queries.sets.items()}
    else:
        sets = {size: method.score_sets(touch_encodings, photo_encodings, rows) for size, rows in queries.sets.items()}
    query_s = [
        _timed(lambda: method.score(method.encode_touch(touch[:1]), photo_encodings))[1] for _ in range(_QUERY_REPEATS)
    ]
    seconds = {
        "fit": fit_s,
        "encode_touch": touch_s / len(touch),
        "encode_photo": photo_s / len(photo),
        "score": score_s / scores.size,
        "query": float(np.median(query_s)),  # of one touch against the whole gallery, from its features
    }
    return MethodScores(queries, scores, sets, method.best_params, seconds, seed, allows_own_photos)


def _timed(work: Callable[[], NDArray[np.float32]]) -> tuple[NDArray[np.float32], float]:
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start
