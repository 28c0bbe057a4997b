"""Protocols: from a table of scores to the values of every query, each with its gallery and its chance.

The gallery of a row never holds photos of its own grasps, except in the two protocols of others that define it so
(`objectfolder`, `paired`): object, light and pose stand there as in no other. A row that has nothing else to find is
not asked, and the gallery's words count such rows. Objects count alike: each is a rival as often as any other.
"""

import numpy as np
from numpy.typing import NDArray

from retrieval.errors import BadInput
from retrieval.evaluation.table import ScoreTable, object_scores
from retrieval.metrics import ranking
from retrieval.metrics.auc import weight_below
from retrieval.metrics.guesses import guess_curves
from retrieval.metrics.measure import Measure, object_means, object_weights
from retrieval.metrics.pairs import Calibration


def asked(table: ScoreTable) -> ScoreTable:
    """The table of the rows that have another photo of their object to find. Raises BadInput where none has."""
    if not table.askable.any():
        raise BadInput(
            f"to be asked, {table.row_words} need {table.column_words} of their object from another grasp; none has "
            "any; record more grasps of each object"
        )
    return table if table.askable.all() else table.select(table.askable, np.arange(len(table.photo_owner)))


def gallery_words(table: ScoreTable, kept: ScoreTable) -> str:
    """What was searched, as a reader is told it; `kept` is what `asked` left of the table."""
    own = "those of the same grasp left out" if table.own.any() else "those of the same grasp included"
    words = f"{len(table.objects)} {table.object_words}, {len(table.photo_owner)} {table.column_words}; {own}"
    missing = len(table.touch_owner) - len(kept.touch_owner)
    return words + (f"; {missing} {table.row_words} not asked, which have no other" if missing else "")


def pair_accuracy(table: ScoreTable, calibration: Calibration) -> Measure:
    """The paper's test, half true and half false pairs, in closed form over ALL pairs.

    A row is right on a photo of its object where the calibrated log-odds are above 0, on another object's where they
    are below; exactly 0 is half right, as a coin would be. Value: half the share over its object's photos and half
    that over other photos (the object uniform, then its photo). `calibration`: that of rows like these, fitted on
    validation objects. Chance is 1/2.
    """
    kept = asked(table)
    odds = calibration.log_odds(kept.scores)
    own, others = _halves(kept, (np.sign(odds) + 1) / 2)
    return _measure(table, kept, (own + 1 - others) / 2, 0.5)


def pair_auc(table: ScoreTable) -> Measure:
    """Chance that a photo of the row's object scores higher than another object's; equals count half.

    The other object is drawn uniformly, then its photo. Needs no threshold and no calibration. Chance is 1/2.
    """
    kept = asked(table)
    weights = _rival_weights(kept)
    rows = zip(kept.scores, kept.relevant, kept.relevant & ~kept.own, weights, strict=True)
    values = [weight_below(row[mine], row[~same], weight[~same]).mean() for row, same, mine, weight in rows]
    return _measure(table, kept, np.array(values), 0.5)


def _halves(table: ScoreTable, values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means (T,) of values (T, N) over a row's own object and over the others, its own photos left out."""
    mine = table.relevant & ~table.own
    return (values * mine).sum(1) / mine.sum(1), (values * _rival_weights(table)).sum(1)


def _rival_weights(table: ScoreTable) -> NDArray[np.float64]:
    """(T, N) weights that sum to 1 over a row's other objects: each object alike, then each of its photos."""
    columns = object_weights(table.photo_owner)
    weights = np.where(table.relevant, 0, columns)
    total = weights.sum(1, keepdims=True)
    if not total.all():
        raise BadInput(f"a test needs {table.column_words} of two objects at least; a row is shown its own alone")
    return np.asarray(weights / total)


def k_way(table: ScoreTable, k: int, *, photos: int = 1, draws: int = 16, seed: int = 0) -> Measure:
    """Guess curve (m = k): the object found within 1..k guesses among k candidates, itself and k - 1 others.

    Every candidate is shown by `photos` photos (`object_scores`) and scored by their mean. Photos are drawn `draws`
    times for every row; over the rivals the mean is exact (`guess_curve`). Chance is 1/k, 2/k, ..., 1. Raises
    BadInput for fewer than k objects.
    """
    kept = asked(table)
    scores = object_scores(kept, photos, draws, seed)
    true = np.take_along_axis(scores, np.searchsorted(kept.objects, kept.touch_owner)[None, :, None], 2)
    higher, equal = (scores > true).sum(2).ravel(), (scores == true).sum(2).ravel() - 1
    curves = guess_curves(higher, equal, len(kept.objects) - 1, k).reshape(draws, -1, k).mean(0)
    shown = "a photo" if photos == 1 else f"{photos} photos (fewer where it has no more)"
    words = f"{k} of these objects, each shown by {shown}: {gallery_words(table, kept)}"
    return Measure(curves, kept.touch_owner, np.arange(1, k + 1) / k, words)


def full_gallery(table: ScoreTable) -> dict[str, Measure]:
    """The whole gallery ranked: "recall_1", "recall_5", "recall_10", "mrr", "map"; own photos left out.

    Recall at k: any photo of the object among the first k. Photos ask for touches with `table.transposed()`.
    """
    kept = asked(table)
    shown = ~kept.own
    first = ranking.first_relevant(kept.scores, kept.relevant, shown)
    values = {f"recall_{k}": ranking.recall_at(k, first) for k in (1, 5, 10)}
    chance = {f"recall_{k}": ranking.chance_of_recall(k, kept.relevant, shown) for k in (1, 5, 10)}
    values["mrr"] = ranking.reciprocal_rank(first)
    chance["mrr"] = ranking.chance_of_reciprocal_rank(kept.relevant, shown)
    values["map"] = ranking.average_precision(kept.scores, kept.relevant, shown)
    chance["map"] = ranking.chance_of_average_precision(kept.relevant, shown)
    return {name: _measure(table, kept, values[name], chance[name]) for name in values}


def objectfolder(table: ScoreTable) -> Measure:
    """Cross-sensory retrieval as in the ObjectFolder benchmark: mean average precision over ALL instances.

    The gallery holds every instance of the other modality, that of the query's own grasp included. The other way
    round with `table.transposed()`.
    """
    return full_gallery(table.with_own())["map"]


def paired(table: ScoreTable) -> dict[str, Measure]:
    """ "paired_top1", "paired_top5": the whole set as one batch, both directions averaged, as TVL measures.

    What must be found is the photo (the touch) of the very same grasp; other photos of the object are wrong answers.
    Raises BadInput unless rows and columns are the same grasps.
    """
    if table.own.shape[0] != table.own.shape[1] or (table.own.sum(1) != 1).any() or (table.own.sum(0) != 1).any():
        raise BadInput("a paired batch needs one photo for each touch; give a table of single grasps and their photos")
    every = np.ones_like(table.own)
    ways = [ranking.first_relevant(table.scores, table.own, every)]
    ways.append(ranking.first_relevant(table.scores.T, table.own.T, every))
    column = table.own.argmax(1)
    count = len(every)
    words = (
        f"{count} grasps in one batch, {len(table.objects)} {table.object_words}; that of the same grasp is asked for"
    )
    found = {}
    for k in (1, 5):
        values = (ranking.recall_at(k, ways[0]) + ranking.recall_at(k, ways[1])[column]) / 2
        found[f"paired_top{k}"] = Measure(values[:, None], table.touch_owner, np.array([min(1.0, k / count)]), words)
    return found


def _measure(
    table: ScoreTable, kept: ScoreTable, values: NDArray[np.float64], chance: NDArray[np.float64] | float
) -> Measure:
    """One value a query; the chance of queries is averaged as their values are."""
    level = np.sum(object_weights(kept.touch_owner) * chance)
    return Measure(values[:, None], kept.touch_owner, np.array([level]), gallery_words(table, kept))


def per_object(measure: Measure, column: int = 0) -> dict[int, float]:
    """Mean value of each object's queries, by its number; of a guess curve, column 0 is the first guess."""
    objects, means = measure.by_object()
    return dict(zip(objects.tolist(), means[:, column].tolist(), strict=True))


def confusions(table: ScoreTable, *, photos: int = 1, draws: int = 16, seed: int = 0) -> list[tuple[int, int, float]]:
    """Who took an object's first place: (object, mistaken for, share of its first guesses), largest share first.

    All objects of the gallery are candidates, each shown by `photos` photos drawn `draws` times; equals share the
    place. Right guesses are not listed, so an object's shares add up to 1 less its share of right ones.
    """
    kept = asked(table)
    scores = object_scores(kept, photos, draws, seed)
    first = scores == scores.max(2, keepdims=True)
    shares = (first / first.sum(2, keepdims=True)).mean(0)
    objects, means = object_means(shares, kept.touch_owner)
    names = kept.objects
    found = [(int(objects[row]), int(names[column]), float(means[row, column])) for row, column in np.argwhere(means)]
    return sorted((item for item in found if item[0] != item[1]), key=lambda item: (-item[2], *item[:2]))


def true_ranks(table: ScoreTable) -> NDArray[np.float64]:
    """(T,) expected rank, from 1, of the first photo of a row's object, own photos left out; NaN where it has none."""
    rows, shown = table.askable, ~table.own
    ranks = np.full(len(rows), np.nan)
    ranks[rows] = ranking.first_rank(ranking.first_relevant(table.scores[rows], table.relevant[rows], shown[rows]))
    return ranks
