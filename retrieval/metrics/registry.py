"""Metrics of an evaluation: each turns a score table into one value per query, with its gallery and chance.

The gallery of a row excludes the photos of its own grasps, which have object, light and pose in common with it; the
protocols of other benchmarks include them (`with_own`). Rows without another photo of their object are not queries;
the description of the gallery states how many there are. In pair and K-way tests other objects have equal weight,
however many photos they have; in rankings of the whole gallery each photo counts.

A new metric is one function from a `ScoreTable` to a `Measure` and one row of `METRICS`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.metrics import ranking
from retrieval.metrics.measure import Measure, object_means, object_weights, weight_below
from retrieval.metrics.table import ScoreTable, object_scores

SET_SIZES = (1, 2, 3, 5, 8, 12, 20)
"""Numbers of grasps in a query."""
PHOTOS_PER_CANDIDATE = 3
"""Photos of a candidate in the metrics of several grasps."""


def pair_accuracy(table: ScoreTable, threshold: float) -> Measure:
    """The paper's test, half true and half false pairs, in closed form over ALL pairs.

    A row is correct on a photo of its object if the score is above the threshold, and on another object's photo if it
    is below; exactly the threshold counts half. The value is the mean of two fractions: over its object's photos, and
    over other photos (a uniform object, then a uniform photo of it). Chance is 1/2.
    """
    queries = table.with_targets
    above = (np.sign(queries.scores.astype(float) - threshold) + 1) / 2
    is_true = queries.relevant & ~queries.own
    own, others = (above * is_true).sum(1) / is_true.sum(1), (above * _rival_weights(queries)).sum(1)
    return _measure(table, (own + 1 - others) / 2, 0.5)


def pair_auc(table: ScoreTable) -> Measure:
    """Probability that a photo of the row's object scores higher than another object's; ties count half.

    The other object is drawn uniformly, then its photo. Neither threshold nor calibration is needed. Chance is 1/2.
    """
    queries = table.with_targets
    weights = _rival_weights(queries)
    rows = zip(queries.scores, queries.relevant, queries.relevant & ~queries.own, weights, strict=True)
    values = [weight_below(row[mine], row[~same], weight[~same]).mean() for row, same, mine, weight in rows]
    return _measure(table, np.array(values), 0.5)


def _rival_weights(table: ScoreTable) -> NDArray[np.float64]:
    """Return weights (T, N) that sum to 1 over a row's other objects: equal for objects, then for their photos."""
    columns = object_weights(table.photo_owner)
    weights = np.where(table.relevant, 0, columns)
    total = weights.sum(1, keepdims=True)
    if not total.all():
        raise BadInput(f"a test needs {table.items} of at least two objects; a row has only those of one object")
    return np.asarray(weights / total)


def k_way(table: ScoreTable | None, k: int, *, photos: int = 1, draws: int = 16, seed: int = 0) -> Measure | None:
    """Top-n accuracy for n in 1..k among k candidates: the row's object and k - 1 others.

    Every candidate is represented by `photos` photos (`object_scores`) and scored by their mean. Photos are drawn
    `draws` times for every row. The expectation over the random choice of the other objects is computed in closed form
    (`ranking.k_way_accuracies`). Chance is 1/k, 2/k, ..., 1. None without a table of at least k objects.
    """
    if table is None or len(table.objects) < k:
        return None
    queries = table.with_targets
    scores = object_scores(queries, photos, draws, seed)
    true = np.take_along_axis(scores, np.searchsorted(queries.objects, queries.touch_owner)[None, :, None], 2)
    higher, equal = (scores > true).sum(2).ravel(), (scores == true).sum(2).ravel() - 1
    curves = ranking.k_way_accuracies(higher, equal, len(queries.objects) - 1, k).reshape(draws, -1, k).mean(0)
    shown = "a photo" if photos == 1 else f"{photos} photos (fewer if it has no more)"
    words = f"{k} of these objects, each with {shown}: {table.gallery}"
    return Measure(curves, queries.touch_owner, np.arange(1, k + 1) / k, words)


def recall(table: ScoreTable, k: int) -> Measure:
    """R@k (hit rate): whether any photo of the object is among the first k of the gallery, without own photos.

    For photos as queries and touches as gallery, use `table.transposed()`.
    """
    return _rank_measure(table, lambda queries: ranking.recall_at(k, queries.scores, queries.relevant, ~queries.own))


def average_precision(table: ScoreTable) -> Measure:
    """Average precision over the whole gallery, without own photos.

    With `table.with_own()` this is the cross-sensory retrieval of the ObjectFolder benchmark, whose gallery contains
    every instance of the other modality, including that of the query's own grasp.
    """
    return _rank_measure(
        table, lambda queries: ranking.average_precision(queries.scores, queries.relevant, ~queries.own)
    )


def _rank_measure(table: ScoreTable, value: Callable[[ScoreTable], NDArray[np.float64]]) -> Measure:
    """Return the value of each query; that of a constant scorer is chance, because ties count by expectation."""
    queries = table.with_targets
    return _measure(table, value(queries), value(replace(queries, scores=np.zeros_like(queries.scores))))


def _measure(table: ScoreTable, values: NDArray[np.float64], chance: NDArray[np.float64] | float) -> Measure:
    """Return one value for each query; chance is averaged like the values."""
    owner = table.with_targets.touch_owner
    level = np.sum(object_weights(owner) * chance)
    return Measure(values[:, None], owner, np.array([level]), table.gallery)


def confusions(table: ScoreTable, *, photos: int = 1, draws: int = 16, seed: int = 0) -> list[tuple[int, int, float]]:
    """Return wrong objects that rank first: (object, confused with, fraction of its queries), largest fraction first.

    All objects of the gallery are candidates, each represented by `photos` photos that are drawn `draws` times. Objects
    that tie for the first rank share it equally. Correct results are not listed, so an object's fractions add up to 1
    minus its accuracy.
    """
    queries = table.with_targets
    scores = object_scores(queries, photos, draws, seed)
    first = scores == scores.max(2, keepdims=True)
    fractions = (first / first.sum(2, keepdims=True)).mean(0)
    objects, means = object_means(fractions, queries.touch_owner)
    names = queries.objects
    found = [(int(objects[row]), int(names[column]), float(means[row, column])) for row, column in np.argwhere(means)]
    return sorted((item for item in found if item[0] != item[1]), key=lambda item: (-item[2], *item[:2]))


# The table of metrics -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class MethodScoreTables:
    """Scores of one method and seed as tables: the input of the metrics.

    Attributes:
        test: Touches with photos of test objects.
        all_objects: The same touches with the photos of all objects.
        sets: By number of grasps, sets of test touches with photos of test objects.
        threshold: Score above which a touch and a photo are classified as a match; None without a threshold.
        seed: Seed of random draws.
    """

    test: ScoreTable
    all_objects: ScoreTable
    sets: dict[int, ScoreTable]
    threshold: float | None
    seed: int


@dataclass(frozen=True)
class Metric:
    """A metric, as results and reports use it.

    Attributes:
        label: Name in the report.
        section: Name of its table.
        compute: Returns its values; None if these scores do not allow it.
        short_label: Heading in its table, if shorter than the label.
    """

    label: str
    section: str
    compute: Callable[[MethodScoreTables], Measure | None]
    short_label: str = ""


def grasps_metric_name(count: int) -> str:
    """Return the name of the metric of a query of `count` grasps, with three photos of each candidate."""
    return f"topn_k5_g{count}_p{PHOTOS_PER_CANDIDATE}"


def _top1_of(k: int, table: Callable[[MethodScoreTables], ScoreTable], words: str = "") -> Metric:
    return Metric(f"{k}-way top-1 accuracy{words}", "main", lambda tables: k_way(table(tables), k, seed=tables.seed))


def _grasps_metric(count: int) -> Metric:
    words = f"{count} grasp{'s' * (count > 1)}"
    return Metric(
        f"5-way top-1 accuracy, {words}, {PHOTOS_PER_CANDIDATE} photos",
        "grasps",
        lambda tables: k_way(tables.sets.get(count), 5, photos=PHOTOS_PER_CANDIDATE, seed=tables.seed),
        words,
    )


def _gallery_metric(column: str, value: Callable[[ScoreTable], Measure]) -> Metric:
    return Metric(f"{column}, touch to photo", "gallery", lambda tables: value(tables.test), column)


METRICS: dict[str, Metric] = {
    "pair_accuracy": Metric(
        "pair accuracy",
        "main",
        lambda tables: None if tables.threshold is None else pair_accuracy(tables.test, tables.threshold),
    ),
    "pair_auc": Metric("pair AUC", "main", lambda tables: pair_auc(tables.test)),
    **{f"topn_k{k}": _top1_of(k, lambda tables: tables.test) for k in (5, 10, 100)},
    "topn_k5_all_objects": _top1_of(5, lambda tables: tables.all_objects, ", all objects"),
    **{grasps_metric_name(count): _grasps_metric(count) for count in SET_SIZES},
    **{f"recall_{k}": _gallery_metric(f"R@{k}", partial(recall, k=k)) for k in (1, 5, 10)},
    "map": _gallery_metric("mAP", average_precision),
}
"""Name in results.json -> metric, in the order of every table."""
