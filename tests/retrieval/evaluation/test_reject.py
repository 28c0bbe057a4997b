"""Open-set rejection: plain loops, uninformative scorers, and hard scores."""

import numpy as np
import pytest

from retrieval.evaluation.queries import fit_posterior as fit
from retrieval.evaluation.queries import identification_trials
from retrieval.evaluation.reject import galleries, reject, statistic
from retrieval.metrics.intervals import summarise
from tests.retrieval.metrics.test_registry import table_of


def planted(objects=12, grasps=8, gap=3.0, seed=0):
    """Return noise of deviation 1, with scores of true pairs higher by `gap`."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), grasps)
    return table_of(gap * (owner[:, None] == owner) + rng.normal(size=(len(owner),) * 2), owner)


def rejection(gap, **more):
    return reject(fit(planted(gap=gap, seed=1, **more)), planted(gap=gap, seed=2, **more))


def value(measure):
    return summarise([measure]).value[0]


def test_a_constant_scorer_is_exactly_at_chance():
    owner = np.repeat(np.arange(5), 3)
    table = table_of(np.full((15, 15), 7.0), owner)
    found = reject(fit(table), table)
    assert value(found.auroc) == pytest.approx(0.5, abs=1e-12)
    assert value(found.balanced_accuracy) == 0.5
    assert found.roc == [[0, 0], [pytest.approx(1), pytest.approx(1)]]
    assert found.auroc.chance.tolist() == found.balanced_accuracy.chance.tolist() == [0.5]


def test_a_larger_gallery_with_the_object_makes_an_uninformative_scorer_seem_better():
    """The best of n + 1 random scores exceeds the best of n: 0.6 for galleries of 3 and 2, by exchangeability."""
    rng = np.random.default_rng(0)
    odds, true = rng.normal(size=(20_000, 3)), np.tile([True, False, False], (20_000, 1))
    naive = [odds.max(1), odds[:, 1:].max(1)]
    assert np.mean(naive[0] > rng.permutation(naive[1])) == pytest.approx(0.6, abs=0.015)
    present, absent = map(statistic, galleries(odds, true))
    assert np.mean(present > rng.permutation(absent)) == pytest.approx(0.5, abs=0.015)


def test_area_and_balanced_accuracy_equal_plain_loops():
    posterior, table = fit(planted(gap=1.5, seed=1)), planted(gap=1.5, seed=2)
    found = reject(posterior, table)
    ratios = []
    for row, scores in enumerate(table.scores):
        others = [(table.photo_owner == name) & (np.arange(len(scores)) != row) for name in table.objects]
        likelihoods = [np.mean([np.exp(posterior.slope * float(score)) for score in scores[mine]]) for mine in others]
        ratios.append(np.log(likelihoods) + posterior.offset)
    present, absent = map(statistic, galleries(np.array(ratios), table.touch_owner[:, None] == table.objects))
    won = [1.0 if a > b else 0.5 if a == b else 0.0 for a in present for b in absent]
    assert value(found.auroc) == pytest.approx(np.mean(won))
    accepted = [np.mean([each >= 0 for each in part]) for part in (present, absent)]
    assert value(found.balanced_accuracy) == pytest.approx((accepted[0] + 1 - accepted[1]) / 2)


def test_the_decision_is_that_of_a_query_at_even_prior():
    posterior, table = fit(planted(gap=1.5, seed=1)), planted(gap=1.5, seed=2, objects=5, grasps=2)
    ratios = identification_trials(table).log_ratios(posterior)
    for gallery in galleries(ratios, table.touch_owner[:, None] == table.objects):
        for row, log_odds in zip(gallery, statistic(gallery), strict=True):
            logits = (row[np.isfinite(row)] - posterior.offset) / posterior.slope
            none = posterior.probabilities_given(logits, posterior.mass(logits)).none
            assert log_odds == pytest.approx(np.log((1 - none) / none))


def test_the_roc_runs_from_corner_to_corner_and_has_the_reported_area():
    found = rejection(gap=1.5, grasps=5)
    alarms, hits = np.array(found.roc).T
    assert (found.roc[0], found.roc[-1]) == ([0, 0], pytest.approx([1, 1]))
    assert (np.diff(found.roc, axis=0) >= 0).all()
    assert len(found.roc) <= 200
    assert np.trapezoid(hits, alarms) == pytest.approx(value(found.auroc), abs=1e-9)


def test_values_vary_over_objects_as_the_area_varies_over_draws_of_objects():
    """Naive: half of P(present > absent) + P(present > absent) has the right mean but half the spread."""
    areas, errors, naive = [], [], []
    rng, posterior = np.random.default_rng(0), fit(planted())
    for trial in range(40):
        skill, level = rng.normal(1.0, 1.0, 14), rng.normal(0, 2, 14)  # the level raises hits and alarms of an object
        owner = np.repeat(np.arange(14), 6)
        noise = rng.normal(size=(84, 84)) + level[owner][:, None]
        table = table_of(np.where(owner[:, None] == owner, 3 * skill[owner][:, None], 0) + noise, owner)
        measure = reject(posterior, table, seed=trial).auroc
        _, means = measure.by_object()
        areas.append(means.mean())
        errors.append(means.std(ddof=1) / np.sqrt(14))
        naive.append(((means + means.mean()) / 2).std(ddof=1) / np.sqrt(14))
    assert np.mean(errors) == pytest.approx(np.std(areas, ddof=1), rel=0.2)  # 40 trials measure a deviation to 12 %
    assert np.mean(naive) < 0.7 * np.std(areas, ddof=1)
