"""Metrics against plain loops, by hand, and with scorers without or with complete information."""

from itertools import combinations, product

import numpy as np
import pytest

from retrieval.errors import BadInput
from retrieval.metrics.registry import (
    METRICS,
    SET_SIZES,
    MethodScoreTables,
    average_precision,
    confusions,
    k_way,
    pair_accuracy,
    pair_auc,
    recall,
)
from retrieval.metrics.table import ScoreTable


def full_gallery(table):
    """Return every measure of the whole gallery."""
    recalls = {f"recall_{k}": recall(table, k) for k in (1, 5, 10)}
    return {**recalls, "map": average_precision(table)}


def table_of(scores, touch_owner, photo_owner=None, own=None):
    photo_owner = touch_owner if photo_owner is None else photo_owner
    own = np.eye(len(touch_owner), len(photo_owner)) if own is None else own
    return ScoreTable(
        np.asarray(scores, dtype=np.float32), np.array(touch_owner), np.array(photo_owner), np.array(own, dtype=bool)
    )


def uneven(seed=0, values=5):
    """Return four objects of 2, 3, 4 and 5 grasps in mixed order, with few distinct scores and so many ties."""
    rng = np.random.default_rng(seed)
    owner = rng.permutation(np.repeat([3, 5, 8, 9], [2, 3, 4, 5]))
    return table_of(rng.integers(-values, values + 1, (14, 14)), owner)


def perfect(objects=6, grasps=4):
    """Return scores with every photo of the object above every other."""
    owner = np.repeat(np.arange(objects), grasps)
    return table_of(np.where(owner[:, None] == owner, 3.0, -3.0), owner)


def others_of(table, row):
    """Return the columns of each other object."""
    return [np.flatnonzero(table.photo_owner == name) for name in table.objects if name != table.touch_owner[row]]


def mine_of(table, row):
    return np.flatnonzero((table.photo_owner == table.touch_owner[row]) & ~table.own[row])


def test_pair_accuracy_and_auc_equal_those_of_two_loops():
    table = uneven()
    accuracy, area = pair_accuracy(table, 1.0).values[:, 0], pair_auc(table).values[:, 0]
    for row in range(14):
        above = [0.5 if score == 1 else float(score > 1) for score in table.scores[row]]
        mine, others = mine_of(table, row), others_of(table, row)
        false = np.mean([np.mean([1 - above[column] for column in columns]) for columns in others])
        assert accuracy[row] == pytest.approx((np.mean([above[column] for column in mine]) + false) / 2, abs=1e-12)
        wins = []
        for columns in others:
            pairs = [(table.scores[row, a], table.scores[row, b]) for a in mine for b in columns]
            wins.append(np.mean([1.0 if a > b else 0.5 if a == b else 0.0 for a, b in pairs]))
        assert area[row] == pytest.approx(np.mean(wins), abs=1e-12)


def k_way_by_enumeration(table, row, k, photos):
    """Return the exact top-n curve of a row, over every choice of photos and rivals and every order of ties."""
    shown = [
        [np.mean(table.scores[row, list(chosen)]) for chosen in combinations(columns, min(photos, len(columns)))]
        for columns in [mine_of(table, row), *others_of(table, row)]
    ]
    curve, cases = np.zeros(k), 0
    for true, *others in product(*shown):
        for rivals in combinations(others, k - 1):
            above, tied = sum(rival > true for rival in rivals), sum(rival == true for rival in rivals)
            curve += [min(max((rank - above) / (tied + 1), 0), 1) for rank in range(1, k + 1)]
            cases += 1
    return curve / cases


@pytest.mark.parametrize(("k", "photos"), [(3, 1), (4, 3)])
def test_k_way_curves_converge_to_those_over_every_draw(k, photos):
    table = uneven(values=2)
    found = k_way(table, k, photos=photos, draws=600)
    for row in range(14):
        exact = k_way_by_enumeration(table, row, k, photos)
        np.testing.assert_allclose(found.values[row], exact, atol=0.1)  # five standard errors of 600 draws
    assert k_way(table, 5) is None  # there are four objects


def test_every_metric_is_computed_if_the_scores_allow_it_and_is_none_otherwise():
    """Four objects do not suffice for 5-way tests, no sets were drawn, and two grasps have the same photo."""
    table = perfect(objects=100, grasps=2)
    every = MethodScoreTables(table, table, dict.fromkeys(SET_SIZES, table), 0.0, seed=0)
    assert all(metric.compute(every) for metric in METRICS.values())
    table = perfect(objects=4, grasps=4)
    shared = table.select(np.arange(16), np.arange(0, 16, 2))
    shared.own[np.arange(1, 16, 2), np.arange(8)] = True
    few = MethodScoreTables(shared, shared, {}, None, seed=0)
    assert {name for name, metric in METRICS.items() if metric.compute(few)} == {
        "pair_auc", "recall_1", "recall_5", "recall_10", "map",
    }  # fmt: skip


def every_measure(table):
    return {
        "pair_accuracy": pair_accuracy(table, 0.0),
        "pair_auc": pair_auc(table),
        "k3": k_way(table, 3),
        "k4p3": k_way(table, 4, photos=3),
        **full_gallery(table),
        **{f"back_{name}": measure for name, measure in full_gallery(table.transposed()).items()},
        "objectfolder": average_precision(table.with_own()),
    }


@pytest.mark.parametrize("value", [0.0, -3e38])
def test_a_constant_scorer_is_exactly_at_chance_in_every_measure(value):
    table = uneven()
    table = table_of(np.full((14, 14), value), table.touch_owner)
    for name, measure in every_measure(table).items():
        _, means = measure.by_object()
        np.testing.assert_allclose(means.mean(0), measure.chance, atol=1e-12, err_msg=name)


def test_a_perfect_scorer_is_right_in_every_measure():
    for name, measure in every_measure(perfect()).items():
        np.testing.assert_allclose(measure.values, 1, atol=1e-12, err_msg=name)


def test_rows_without_another_photo_of_their_object_are_counted_and_neither_hidden_nor_scored_0():
    table = table_of(np.arange(16).reshape(4, 4), [0, 0, 1, 2])
    for measure in (pair_accuracy(table, 0.0), pair_auc(table), k_way(table, 2), *full_gallery(table).values()):
        assert measure.owner.tolist() == [0, 0]
        assert measure.gallery.endswith("; 2 queries left out, which have no other")
    with pytest.raises(BadInput, match="from another grasp; none has"):
        pair_auc(table_of(np.zeros((2, 2)), [0, 1]))


def test_the_largest_confusion_comes_first_and_correct_results_are_not_listed():
    scores = np.array([[0, 5, 9, 0, 0], [5, 0, 9, 0, 0], [0, 0, 5, 5, 0], [0, 0, 5, 5, 5], [9, 9, 9, 9, 0]])
    found = confusions(table_of(scores, [0, 0, 1, 1, 2], own=np.zeros((5, 5))), photos=2, draws=1)
    # Object 0: means 2.5, 4.5, 0 twice. Object 1: one correct, then 0, 5, 5, a tie. Object 2: 9, 9, 0, a tie.
    assert found == [(0, 1, 1.0), (2, 0, 0.5), (2, 1, 0.5), (1, 2, 0.25)]
    assert confusions(perfect()) == []


def test_without_ties_and_own_photos_the_metrics_equal_those_of_trec_eval():
    """trec_eval gets the gallery of each query, which excludes photos of its own grasp, in the run and in the qrels.

    R@k is "any relevant item among the first k", which trec_eval calls success.
    """
    trec_eval, ks = pytest.importorskip("pytrec_eval"), (1, 2, 3, 5)
    rng = np.random.default_rng(1)
    owner = np.repeat(np.arange(6), 4)
    scores = rng.permuted(np.tile(np.arange(24, dtype=np.float32), (24, 1)), axis=1)
    table = table_of(scores, owner)
    qrels, run = (
        {str(q): {str(i): kind(values[q, i]) for i in np.flatnonzero(~table.own[q])} for q in range(24)}
        for values, kind in ((table.relevant, int), (scores, float))
    )
    theirs = trec_eval.RelevanceEvaluator(qrels, {"map", "success." + ",".join(map(str, ks))}).evaluate(run)
    ours = {"map": average_precision(table)} | {f"success_{k}": recall(table, k) for k in ks}
    for name, measure in ours.items():
        expected = [theirs[str(q)][name] for q in range(24)]
        np.testing.assert_allclose(measure.values[:, 0], expected, rtol=1e-12, atol=1e-14, err_msg=name)
