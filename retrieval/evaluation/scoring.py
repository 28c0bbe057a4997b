"""From the predictions of a method to its part of results.json: measures, confusions, calibration, examples."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval.evaluation.calibrate import (
    Calibrations,
    KWayTest,
    PairRule,
    calibrate,
    has_enough_objects,
    pair_rule,
    reliability,
)
from retrieval.evaluation.example_grasps import ExampleGrasps
from retrieval.evaluation.predictions import Predictions
from retrieval.evaluation.queries import Queries
from retrieval.evaluation.reject import Rejection, reject
from retrieval.metrics import protocols
from retrieval.metrics.intervals import summarise
from retrieval.metrics.measure import Measure
from retrieval.metrics.registry import PHOTOS_PER_CANDIDATE, MethodScoreTables, compute, k_way_measure
from retrieval.metrics.table import ScoreTable

CHOICES = (KWayTest(5), KWayTest(10), KWayTest(5, 5, PHOTOS_PER_CANDIDATE))
_CONFUSIONS = 12
_GUESSES = (5, 10)

Measures = dict[str, Measure]


@dataclass(frozen=True, eq=False)
class MethodScores:
    """One method and seed: its scores as tables for the protocols, and what validation objects say of them."""

    queries: Queries
    predictions: Predictions
    seed: int

    def touches(self, rows: str | None, columns: str | None) -> ScoreTable:
        """Touches of one part of the split with photos of one; None for all parts."""
        asked = self.queries
        touches, photos = _of(asked, asked.touch_owner, rows), _of(asked, asked.photo_owner, columns)
        return ScoreTable(
            scores=self.predictions.scores[np.ix_(touches, photos)],
            touch_owner=asked.touch_owner[touches],
            photo_owner=asked.photo_owner[photos],
            own=asked.own_photo[touches][:, None] == photos,
            object_words=f"{columns} objects" if columns else "objects of all parts",
        )

    def sets(self, part: str) -> dict[int, ScoreTable]:
        """Scores of sets of grasps of a part with the photos of that part, by the number of grasps in a set; sizes that
        can be asked.
        """
        tables = {size: self._sets(part, size) for size in self.queries.sets}
        return {size: table for size, table in tables.items() if table is not None and table.has_target.any()}

    def _sets(self, part: str, size: int) -> ScoreTable | None:
        asked, sets = self.queries, self.queries.sets[size]
        owner = asked.touch_owner[sets[:, 0]]
        rows, photos = asked.of_part(owner, part), asked.of_part(asked.photo_owner, part)
        if not len(rows):
            return None
        return ScoreTable(
            scores=self.predictions.set_scores[size][np.ix_(rows, photos)],
            touch_owner=owner[rows],
            photo_owner=asked.photo_owner[photos],
            own=(asked.own_photo[sets[rows]][:, :, None] == photos).any(1),
            object_words=f"{part} objects",
            row_words="sets of grasps",
        )

    def by_grasps(self, part: str) -> dict[int, ScoreTable]:
        """Scores by number of grasps, as calibration takes them: single touches, and sets of more grasps."""
        return {1: self.touches(part, part)} | {size: table for size, table in self.sets(part).items() if size > 1}

    def ids(self, grasp_ids: Sequence[str], part: str) -> tuple[list[str], list[str]]:
        """Grasp ids of the touches (rows) and the photos (columns) of a part."""
        asked = self.queries
        return (
            [grasp_ids[row] for row in asked.touches[_of(asked, asked.touch_owner, part)]],
            [grasp_ids[row] for row in asked.photos[_of(asked, asked.photo_owner, part)]],
        )

    def score_tables(self) -> MethodScoreTables:
        """What metrics are taken of."""
        return MethodScoreTables(
            test=self.touches("test", "test"),
            all_objects=self.touches("test", None),
            sets=self.sets("test"),
            rule=self.pair_rule.rule,
            seed=self.seed,
        )

    def measures(self, names: Iterable[str]) -> Measures:
        """The metrics of these names."""
        return compute(self.score_tables(), names)

    @cached_property
    def pair_rule(self) -> PairRule:
        """Which pairs of a single touch and a photo are called matches."""
        return pair_rule(self.predictions.best_params, self.touches("validation", "validation"), seed=self.seed)


def _of(queries: Queries, owner: NDArray[np.int64], part: str | None) -> NDArray[np.int64]:
    return np.arange(len(owner)) if part is None else queries.of_part(owner, part)


def summaries(by_seed: Sequence[Measures], draws: int, seed: int) -> dict[str, Any]:
    """The "measures" of results.json."""
    return {name: summarise([found[name] for found in by_seed], draws=draws, seed=seed) for name in by_seed[0]}


def score_method(
    queries: Queries, grasp_ids: Sequence[str], by_seed: Sequence[Predictions], *, draws: int, seed: int
) -> tuple[dict[str, Any], list[Measures]]:
    """A method's entry of results.json, and its measures by training seed for comparisons.

    Values are means over the training seeds; reliability, reject's curves and the grasps shown are those of the first.
    "reject" is None where validation or test objects are fewer than three.
    """
    judged = [MethodScores(queries, predictions, seed) for predictions in by_seed]
    shown = ExampleGrasps(judged[0].touches("test", "test"), queries.objects, *judged[0].ids(grasp_ids, "test"))
    calibrations = [calibrate(one.by_grasps("validation"), seed=seed) for one in judged]
    measures = [compute(one.score_tables()) for one in judged]
    entry = {
        "best_params": [predictions.best_params for predictions in by_seed],
        "pair_threshold": judged[0].pair_rule.to_dict(),
        "measures": summaries(measures, draws, seed),
        "per_object": _per_object(queries, judged, measures, seed),
        "confusions": _confusions(queries, judged, shown, seed),
        "calibration": calibrations[0].to_dict(),
        "reliability": reliability(calibrations[0], judged[0].by_grasps("test"), CHOICES, seed=seed),
        "reject": _reject(judged, calibrations, draws, seed),
        "examples": shown.examples(),
        "examples_by_rank": {str(k): found for k in _GUESSES if (found := shown.guessed(k, seed))},
    }
    return entry, measures


def _per_object(
    queries: Queries, judged: Sequence[MethodScores], measures: Sequence[Measures], seed: int
) -> dict[str, dict[str, float]]:
    """Mean first guess at K = 5 of each object: among test objects, and of every object among all."""
    every = [k_way_measure(one.touches(None, None), 5, seed) for one in judged]
    shares = {
        "test_candidates": [found["topn_k5"] for found in measures if "topn_k5" in found],
        "all_candidates": [measure for measure in every if measure],
    }
    return {name: _mean_by_name(queries, map(protocols.per_object, found)) for name, found in shares.items()}


def _mean_by_name(queries: Queries, by_seed: Iterable[Mapping[int, float]]) -> dict[str, float]:
    found: dict[str, list[float]] = {}
    for shares in by_seed:
        for number, share in shares.items():
            found.setdefault(queries.objects[number], []).append(share)
    return {name: float(np.mean(values)) for name, values in found.items()}


def _confusions(
    queries: Queries, judged: Sequence[MethodScores], shown: ExampleGrasps, seed: int
) -> list[dict[str, Any]]:
    """The largest shares of first guesses among all test objects that fell on a wrong one."""
    shares: dict[tuple[int, int], float] = {}
    for one in judged:
        for true, guessed, share in protocols.confusions(one.touches("test", "test"), seed=seed):
            shares[true, guessed] = shares.get((true, guessed), 0) + share / len(judged)
    largest = sorted(shares.items(), key=lambda item: (-item[1], item[0]))[:_CONFUSIONS]
    names = queries.objects
    return [
        {
            "object_id": names[true],
            "mistaken_for": names[guessed],
            "share": share,
            "grasps": shown.confusion_examples(true, guessed),
        }
        for (true, guessed), share in largest
    ]


def _reject(
    judged: Sequence[MethodScores], calibrations: Sequence[Calibrations], draws: int, seed: int
) -> dict[str, Any] | None:
    """The "reject" of results.json: everything about single grasps, and for each number of grasps how well objects of
    the catalogue and others are told apart.
    """
    found = [_rejections(one, fitted, seed) for one, fitted in zip(judged, calibrations, strict=True)]
    if not found[0]:
        return None

    def summary(name: str, grasps: int = 1) -> dict[str, Any]:
        return summarise([getattr(one[grasps], name) for one in found], draws=draws, seed=seed)

    parted = ("auroc", "false_accepts_at_95")
    return {
        **{name: summary(name) for name in (*parted, "balanced_accuracy")},
        "roc": found[0][1].roc,
        "risk_coverage": found[0][1].risk_coverage,
        "by_grasps": {str(grasps): {name: summary(name, grasps) for name in parted} for grasps in found[0]},
    }


def _rejections(judged: MethodScores, calibrations: Calibrations, seed: int) -> dict[int, Rejection]:
    """What "none of these" is worth, by number of grasps, where validation objects gave a posterior and enough test
    objects can be left out.
    """
    tables = judged.by_grasps("test").items()
    fitted = calibrations.posteriors
    return {
        grasps: reject(fitted[grasps], table, seed=seed)
        for grasps, table in tables
        if grasps in fitted and has_enough_objects(table)
    }
