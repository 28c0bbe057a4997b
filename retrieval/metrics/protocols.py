"""Evaluation metrics: each turns a score table into one value per query, with its gallery and the value of chance.

The gallery of a row excludes the photos of its own grasps, which have object, light and pose in common with it; the
protocols of other benchmarks include them (`with_own`). Rows without another photo of their object are not queries;
the description of the gallery states how many there are. In pair and K-way tests other objects have equal weight,
however many photos they have; in rankings of the whole gallery each photo counts.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.metrics import ranking
from retrieval.metrics.measure import Measure, object_means, object_weights, weight_below
from retrieval.metrics.table import ScoreTable, object_scores


def pair_accuracy(table: ScoreTable, threshold: float) -> Measure:
    """The paper's test, half true and half false pairs, in closed form over ALL pairs.

    A row is correct on a photo of its object if the score is above the threshold, and on another object's photo if it
    is below; exactly the threshold counts half. The value is the mean of two fractions: over its object's photos, and
    over other photos (a uniform object, then a uniform photo of it). Chance is 1/2.

    Args:
        table: The scores.
        threshold: The threshold, from validation objects.
    """
    queries = table.with_targets
    own, others = _same_and_other_object_means(queries, (np.sign(queries.scores.astype(float) - threshold) + 1) / 2)
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


def _same_and_other_object_means(
    table: ScoreTable, values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return means (T,) of values (T, N) over the photos of a row's object and over those of the other objects.

    Photos of the row's own grasps are excluded.
    """
    same_object = table.relevant & ~table.own
    return (values * same_object).sum(1) / same_object.sum(1), (values * _rival_weights(table)).sum(1)


def _rival_weights(table: ScoreTable) -> NDArray[np.float64]:
    """Return weights (T, N) that sum to 1 over a row's other objects: equal for objects, then for their photos."""
    columns = object_weights(table.photo_owner)
    weights = np.where(table.relevant, 0, columns)
    total = weights.sum(1, keepdims=True)
    if not total.all():
        raise BadInput(f"a test needs {table.column_words} of at least two objects; a row has only those of one object")
    return np.asarray(weights / total)


def k_way(table: ScoreTable, k: int, *, photos: int = 1, draws: int = 16, seed: int = 0) -> Measure:
    """Top-n accuracy for n in 1..k among k candidates: the row's object and k - 1 others.

    Every candidate is represented by `photos` photos (`object_scores`) and scored by their mean. Photos are drawn
    `draws` times for every row. The expectation over the random choice of the other objects is computed in closed form
    (`ranking.k_way_accuracies`). Chance is 1/k, 2/k, ..., 1. Raises BadInput for fewer than k objects.
    """
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
    return _rank_measure(table, lambda queries: ranking.recall_at(k, queries.first))


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


def per_object(measure: Measure, column: int = 0) -> dict[int, float]:
    """Return the mean value of the queries of each object; of a top-n curve, column 0 is the top-1 accuracy."""
    objects, means = measure.by_object()
    return dict(zip(objects.tolist(), means[:, column].tolist(), strict=True))


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
