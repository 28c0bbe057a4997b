"""Is the object in the catalogue: by loops, with scorers that know nothing or everything, and hard scores."""

import json

import numpy as np
import pytest
from scipy.stats import norm

from retrieval.errors import BadInput
from retrieval.evaluation.intervals import summarise
from retrieval.evaluation.reject import fit_gate, reject, statistics
from retrieval.evaluation.table import ScoreTable


def table_of(scores, owner):
    return ScoreTable(
        np.asarray(scores, dtype=np.float32), np.array(owner), np.array(owner), np.eye(len(owner), dtype=bool)
    )


def planted(objects=12, grasps=8, gap=3.0, seed=0, scale=1.0):
    """Scores of true pairs are higher by `gap`, on noise of deviation 1."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), grasps)
    return table_of(scale * (gap * (owner[:, None] == owner) + rng.normal(size=(len(owner),) * 2)), owner)


def judged(gap, **more):
    return reject(fit_gate(planted(gap=gap, seed=1, **more)), planted(gap=gap, seed=2, **more))


def value(measure):
    return summarise([measure])["value"][0]


def test_a_scorer_that_knows_is_always_right_and_one_that_knows_nothing_is_at_chance():
    knowing = judged(gap=50)
    assert value(knowing.auroc) == pytest.approx(1)
    assert value(knowing.balanced_accuracy) == 1
    blind = judged(gap=0, grasps=40)
    assert value(blind.auroc) == pytest.approx(0.5, abs=0.04)
    assert blind.auroc.chance.tolist() == blind.balanced_accuracy.chance.tolist() == [0.5]


def test_a_constant_scorer_is_exactly_at_chance():
    owner = np.repeat(np.arange(5), 3)
    table = table_of(np.full((15, 15), 7.0), owner)
    found = reject(fit_gate(table), table)
    assert value(found.auroc) == pytest.approx(0.5, abs=1e-12)
    assert value(found.balanced_accuracy) == 0.5
    assert found.roc == [[0, 0], [pytest.approx(1), pytest.approx(1)]]


def test_naively_a_gallery_with_the_object_has_one_more_and_a_scorer_that_knows_nothing_seems_to_know():
    """Of n + 1 random scores the best is higher than of n: .6 for galleries of 3 and 2, by exchangeability."""
    rng = np.random.default_rng(0)
    odds, true = rng.normal(size=(20_000, 3)), np.tile([True, False, False], (20_000, 1))
    naive = [odds.max(1), odds[:, 1:].max(1)]
    assert np.mean(naive[0] > rng.permutation(naive[1])) == pytest.approx(0.6, abs=0.015)
    present, absent = statistics(odds, true)
    assert np.mean(present > rng.permutation(absent)) == pytest.approx(0.5, abs=0.015)


def test_the_statistic_is_the_log_of_the_mean_likelihood_ratio():
    odds, true = np.log([[2.0, 4.0, 8.0]]), np.array([[True, False, False]])
    present, absent = statistics(odds, true)
    assert np.exp(absent) == pytest.approx((4 + 8) / 2)
    assert np.exp(present[0]) in (pytest.approx((2 + 4) / 2), pytest.approx((2 + 8) / 2))


def test_every_rival_is_dropped_as_often():
    odds, true = np.log(np.tile([[2.0, 4.0, 8.0]], (1000, 1))), np.tile([True, False, False], (1000, 1))
    present, _ = statistics(odds, true)
    assert np.mean(np.isclose(np.exp(present), 3)) == pytest.approx(0.5, abs=0.06)


def test_the_statistic_is_finite_where_the_naive_mean_overflows():
    odds, true = np.array([[900.0, 800.0, -900.0]]), np.array([[False, False, True]])
    with np.errstate(over="ignore"):
        assert np.isinf(np.exp(odds).mean())
    _, absent = statistics(odds, true)
    assert absent[0] == pytest.approx(900 - np.log(2))


def test_the_area_is_that_of_two_loops_and_so_is_the_balanced_accuracy():
    gate, table = fit_gate(planted(gap=1.5, seed=1)), planted(gap=1.5, seed=2)
    found = reject(gate, table)
    present, absent = by_hand(gate, table)
    won = [1.0 if a > b else 0.5 if a == b else 0.0 for a in present for b in absent]
    assert value(found.auroc) == pytest.approx(np.mean(won))
    accepted = [np.mean([said >= gate.threshold for said in part]) for part in (present, absent)]
    assert value(found.balanced_accuracy) == pytest.approx((accepted[0] + 1 - accepted[1]) / 2)


def by_hand(gate, table):
    """Statistics of every row, one at a time; which rival is dropped comes from the module itself."""
    scores, true = [], []
    for row, mine in enumerate(table.touch_owner):
        means = []
        for name in np.unique(table.photo_owner):
            columns = [c for c in range(len(table.photo_owner)) if table.photo_owner[c] == name and c != row]
            means.append(np.mean(table.scores[row, columns], dtype=float))
        scores.append(means)
        true.append([name == mine for name in np.unique(table.photo_owner)])
    return statistics(gate.objects.log_odds(scores), np.array(true))


def test_the_curve_runs_from_corner_to_corner_and_has_the_area_that_is_said():
    found = judged(gap=1.5, grasps=5)
    alarms, hits = np.array(found.roc).T
    assert found.roc[0] == [0, 0]
    assert found.roc[-1] == [pytest.approx(1), pytest.approx(1)]
    assert (np.diff(alarms) >= 0).all()
    assert (np.diff(hits) >= 0).all()
    assert len(found.roc) <= 200
    assert np.trapezoid(hits, alarms) == pytest.approx(value(found.auroc), abs=1e-9)
    json.dumps(found.roc)


def test_a_long_curve_is_thinned_and_keeps_its_area():
    found = judged(gap=1.5, objects=15, grasps=30)
    alarms, hits = np.array(found.roc).T
    assert len(found.roc) == 200
    assert np.trapezoid(hits, alarms) == pytest.approx(value(found.auroc), abs=0.002)


def test_the_values_spread_over_objects_as_the_area_does_over_draws_of_objects():
    """Half of P(present > absent) + P(present > absent) would have the right mean and half the spread."""
    areas, errors, naive = [], [], []
    rng, gate = np.random.default_rng(0), fit_gate(planted())
    for trial in range(60):
        skill = rng.normal(1.0, 1.0, 14)
        owner = np.repeat(np.arange(14), 6)
        noise = rng.normal(size=(84, 84))
        table = table_of(np.where(owner[:, None] == owner, 3 * skill[owner][:, None], 0) + noise, owner)
        measure = reject(gate, table, seed=trial).auroc
        _, means = measure.by_object()
        areas.append(means.mean())
        errors.append(means.std(ddof=1) / np.sqrt(14))
        naive.append(((means + means.mean()) / 2).std(ddof=1) / np.sqrt(14))
    assert np.mean(errors) == pytest.approx(np.std(areas, ddof=1), rel=0.3)  # 60 trials tell a deviation to 10 %
    assert np.mean(naive) < 0.7 * np.std(areas, ddof=1)


def test_the_threshold_comes_from_validation_objects_alone():
    gate = fit_gate(planted(seed=1))
    shifted = planted(seed=2)
    shifted = table_of(shifted.scores + 100, shifted.touch_owner)
    found = reject(gate, shifted)
    assert found.threshold == gate.threshold
    assert value(found.balanced_accuracy) == 0.5  # all are accepted
    assert value(found.auroc) > 0.9


@pytest.mark.parametrize("scale", [1e-6, 1e6, 1e30])
def test_scores_of_any_size_are_judged(scale):
    found = judged(gap=50, scale=scale)
    assert 0.5 <= value(found.auroc) <= 1
    assert np.isfinite(found.threshold)


def test_a_gallery_of_one_object_cannot_miss_it():
    with pytest.raises(BadInput, match="needs two at least; got 1"):
        fit_gate(table_of(np.zeros((3, 3)), [0, 0, 0]))


def test_known_areas_are_met():
    """Two objects: present shows the own one alone, absent the other alone; deviation of a mean of many photos is
    small, so the area is that of the planted shift: two normals a deviation apart have Phi(1 / sqrt 2)."""
    rng = np.random.default_rng(0)
    owner = np.repeat([0, 1], 300)
    per_row = rng.normal(size=(600, 2))
    scores = per_row[:, owner] + (owner[:, None] == owner)
    table = table_of(scores, owner)
    assert value(reject(fit_gate(table), table).auroc) == pytest.approx(norm.cdf(1 / np.sqrt(2)), abs=0.03)
