"""Score predictions: measures, confusions, calibration and examples for results.json."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.evaluation.calibrate import (
    Calibrations,
    KWayTest,
    PairThreshold,
    calibrate,
    has_enough_objects,
    pair_threshold,
    reliability,
)
from retrieval.evaluation.predictions import Predictions
from retrieval.evaluation.queries import Queries
from retrieval.evaluation.reject import reject
from retrieval.metrics import protocols
from retrieval.metrics.intervals import summarise
from retrieval.metrics.measure import Measure
from retrieval.metrics.registry import PHOTOS_PER_CANDIDATE, MethodScoreTables, compute, k_way_measure
from retrieval.metrics.table import ScoreTable

CHOICES = (KWayTest(5), KWayTest(10), KWayTest(5, 5, PHOTOS_PER_CANDIDATE))
_CONFUSIONS = 12

Measures = dict[str, Measure]


@dataclass(frozen=True, eq=False)
class MethodScores:
    """Scores of one method and seed, as tables for the metrics.

    Attributes:
        queries: The queries of the evaluation.
        predictions: The scores.
        seed: Seed of drawn tests and pairs.
    """

    queries: Queries
    predictions: Predictions
    seed: int

    def touches(self, rows: str | None, columns: str | None) -> ScoreTable:
        """Return the scores of touches with photos.

        Args:
            rows: Part of the touches; None for all parts.
            columns: Part of the photos; None for all parts.
        """
        queries = self.queries
        touches, photos = _of(queries, queries.touch_owner, rows), _of(queries, queries.photo_owner, columns)
        return ScoreTable(
            scores=self.predictions.scores[np.ix_(touches, photos)],
            touch_owner=queries.touch_owner[touches],
            photo_owner=queries.photo_owner[photos],
            own=queries.own_photo[touches][:, None] == photos,
            object_words=f"{columns} objects" if columns else "objects of all parts",
        )

    def sets(self, part: str) -> dict[int, ScoreTable]:
        """Return the scores of sets of grasps with photos of the same part, by number of grasps.

        Sizes without a set that has a target photo are left out.
        """
        tables = {size: self._sets(part, size) for size in self.queries.sets}
        return {size: table for size, table in tables.items() if table is not None and table.has_target.any()}

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

    def measures(self, names: Iterable[str]) -> Measures:
        """Return the metrics with these names."""
        return compute(self.score_tables(), names)

    @cached_property
    def pair_threshold(self) -> PairThreshold:
        """Return the threshold that classifies a single touch and a photo as match or no match."""
        return pair_threshold(self.predictions.best_params, self.touches("validation", "validation"), seed=self.seed)


def _of(queries: Queries, owner: NDArray[np.int64], part: str | None) -> NDArray[np.int64]:
    return np.arange(len(owner)) if part is None else queries.of_part(owner, part)


def summaries(by_seed: Sequence[Measures], draws: int, seed: int) -> dict[str, Any]:
    """Return "measures" of results.json: means over the seeds with intervals."""
    return {name: summarise([found[name] for found in by_seed], draws=draws, seed=seed) for name in by_seed[0]}


def score_method(
    queries: Queries, by_seed: Sequence[Predictions], *, draws: int, seed: int
) -> tuple[dict[str, Any], list[Measures]]:
    """Return a method's entry of results.json, and its measures by training seed for comparisons.

    Values are means over the training seeds. Reliability and rejection curves are those of the first seed. "reject" is
    None if there are fewer than three validation or test objects.

    Args:
        queries: The queries of the evaluation.
        by_seed: Predictions of each training seed.
        draws: Resamples of an interval.
        seed: Seed of drawn tests, pairs and resamples.
    """
    scored = [MethodScores(queries, predictions, seed) for predictions in by_seed]
    calibrations = [calibrate(one.by_grasps("validation"), seed=seed) for one in scored]
    measures = [compute(one.score_tables()) for one in scored]
    entry = {
        "best_params": [predictions.best_params for predictions in by_seed],
        "pair_threshold": scored[0].pair_threshold.to_dict(),
        "measures": summaries(measures, draws, seed),
        "per_object": _per_object(queries, scored, measures, seed),
        "confusions": _confusions(queries, scored, seed),
        "calibration": calibrations[0].to_dict(),
        "reliability": reliability(calibrations[0], scored[0].by_grasps("test"), CHOICES, seed=seed),
        "reject": _reject(scored, calibrations, draws, seed),
    }
    return entry, measures


def _per_object(
    queries: Queries, scored: Sequence[MethodScores], measures: Sequence[Measures], seed: int
) -> dict[str, dict[str, float]]:
    """Return the mean top-1 of 5 of each object: of test objects among these, and of every object among all."""
    every = [k_way_measure(one.touches(None, None), 5, seed) for one in scored]
    accuracies = {
        "test_candidates": [found["topn_k5"] for found in measures if "topn_k5" in found],
        "all_candidates": [measure for measure in every if measure],
    }
    return {name: _mean_by_name(queries, map(protocols.per_object, found)) for name, found in accuracies.items()}


def _mean_by_name(queries: Queries, by_seed: Iterable[Mapping[int, float]]) -> dict[str, float]:
    found: dict[str, list[float]] = {}
    for accuracies in by_seed:
        for number, accuracy in accuracies.items():
            found.setdefault(queries.objects[number], []).append(accuracy)
    return {name: float(np.mean(values)) for name, values in found.items()}


def _confusions(queries: Queries, scored: Sequence[MethodScores], seed: int) -> list[dict[str, Any]]:
    """Return the most frequent wrong top-1 answers among all test objects."""
    fractions: dict[tuple[int, int], float] = {}
    for one in scored:
        for true, predicted, fraction in protocols.confusions(one.touches("test", "test"), seed=seed):
            fractions[true, predicted] = fractions.get((true, predicted), 0) + fraction / len(scored)
    largest = sorted(fractions.items(), key=lambda item: (-item[1], item[0]))[:_CONFUSIONS]
    names = queries.objects
    return [
        {"object_id": names[true], "mistaken_for": names[predicted], "share": fraction}
        for (true, predicted), fraction in largest
    ]


def _reject(
    scored: Sequence[MethodScores], calibrations: Sequence[Calibrations], draws: int, seed: int
) -> dict[str, Any] | None:
    """Return "reject" of results.json, for single grasps; None without a posterior or with too few test objects."""
    found = []
    for one, fitted in zip(scored, calibrations, strict=True):
        table = one.touches("test", "test")
        if 1 in fitted.posteriors and has_enough_objects(table):
            found.append(reject(fitted.posteriors[1], table, seed=seed))
    if not found:
        return None

    def summary(name: str) -> dict[str, Any]:
        return summarise([getattr(one, name) for one in found], draws=draws, seed=seed)

    return {
        **{name: summary(name) for name in ("auroc", "false_accepts_at_95", "balanced_accuracy")},
        "roc": found[0].roc,
        "risk_coverage": found[0].risk_coverage,
    }
