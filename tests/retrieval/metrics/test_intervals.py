"""Intervals by object: against loops, a published table, scipy, and their coverage."""

import numpy as np
import pytest
from scipy.stats import norm, permutation_test, t

from retrieval.errors import BadInput
from retrieval.metrics.intervals import (
    binomial_interval,
    bootstrap_interval,
    compare,
    compare_splits,
    grouped_interval,
    sign_flip_p,
    summarise,
    summarise_splits,
)
from retrieval.metrics.measure import Measure


def measure_of(by_object, chance=(0.5,)):
    """Return values of queries, object by object."""
    values = np.array([value for part in by_object for value in part], dtype=float).reshape(-1, len(chance))
    owner = np.repeat(np.arange(len(by_object)), [len(part) for part in by_object])
    return Measure(values, owner, np.array(chance), "18 objects")


def some_objects(count=12, queries=7, seed=0):
    rng = np.random.default_rng(seed)
    return [list(rng.random() + 0.1 * rng.normal(size=queries)) for _ in range(count)]


def test_a_value_is_the_mean_of_the_objects_means_so_an_object_with_many_queries_counts_no_more():
    found = summarise([measure_of([[1, 1, 1, 1, 1, 1, 1, 1], [0, 0], [0]])])
    assert found.value == [pytest.approx(1 / 3)]  # naively, over queries, 8 / 11
    assert (found.queries, found.objects, found.chance, found.gallery) == (11, 3, [0.5], "18 objects")


def test_seeds_are_averaged_by_object_and_listed_one_by_one():
    parts = [measure_of(some_objects(seed=seed)) for seed in range(3)]
    found = summarise(parts)
    each = [np.mean([np.mean(part.values[part.owner == name]) for name in range(12)]) for part in parts]
    np.testing.assert_allclose(np.ravel(found.repeats), each)
    assert found.value[0] == pytest.approx(np.mean(each))
    one_seed = summarise(parts[:1])
    # Naively, three seeds would count as three times as many objects.
    assert found.high[0] - found.low[0] > 0.4 * (one_seed.high[0] - one_seed.low[0])
    assert summarise([parts[0]] * 3).low == pytest.approx(one_seed.low)


def test_measures_of_different_queries_are_not_combined():
    one, other = measure_of(some_objects()), measure_of(some_objects(count=11))
    for combine in (lambda: summarise([one, other]), lambda: compare([one], [other])):
        with pytest.raises(BadInput, match="the same queries"):
            combine()


def test_the_interval_equals_that_of_a_loop_over_resamples():
    means = np.random.default_rng(0).random(9)
    rng = np.random.default_rng(1)
    drawn = rng.choice(means, (20_000, 9)).mean(1)
    tail = norm.cdf(-np.sqrt(9 / 8) * t.ppf(0.975, 8))
    low, high = bootstrap_interval(means[:, None], draws=20_000)
    np.testing.assert_allclose([low[0], high[0]], np.quantile(drawn, (tail, 1 - tail)), atol=0.01)


def test_equal_objects_have_an_interval_without_width_and_one_object_the_widest():
    for value in (0.0, 1.0, 1 / 3):
        found = summarise([measure_of([[value] * 4] * 7)])
        assert found.low == found.high == [value]
    found = summarise([measure_of([[0.1 + 0.2]] * 9)] * 3)  # the mean is rounded
    assert found.low[0] <= found.value[0] <= found.high[0]
    found = summarise([measure_of([[0.5, 0.7, 0.9]])])
    assert (found.low, found.value, found.high) == ([0.0], [pytest.approx(0.7)], [1.0])


def coverage(interval_of, trials=200):
    """Return how often the interval contains .7, the mean of the distribution of objects."""
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(trials):
        rates = rng.beta(0.7 * 4, 0.3 * 4, 6)
        hits = rng.binomial(1, rates[:, None], (6, 20)).astype(float)
        low, high = interval_of(hits)
        covered += low <= 0.7 <= high
    return covered / trials


def test_the_interval_by_object_has_its_nominal_coverage_and_a_naive_one_does_not():
    """Six objects; 200 trials measure a coverage of .95 to +- .03. Naive: resampling queries."""
    assert 0.91 <= coverage(lambda hits: bootstrap_interval(hits.mean(1, keepdims=True), draws=1000)) <= 0.99
    assert coverage(lambda hits: bootstrap_interval(hits.reshape(-1, 1), draws=400), trials=40) < 0.75


def test_the_permutation_test_equals_that_of_scipy():
    differences = np.random.default_rng(2).normal(0.4, 1, 9)
    theirs = permutation_test(
        (differences, np.zeros(9)), lambda a, b: np.mean(a - b), permutation_type="samples", n_resamples=np.inf
    )
    assert sign_flip_p(differences) == pytest.approx(theirs.pvalue)


def test_p_equals_that_by_hand():
    assert sign_flip_p(np.ones(6)) == 2 / 64
    assert sign_flip_p(np.full(10, 0.1)) == 2 / 1024  # rounded sums: naively, no flip would reach the observed one
    assert sign_flip_p(np.array([0.1, 0.2, 0.3])) == 2 / 8
    assert sign_flip_p(np.array([0.1, 0.2, -0.3])) == 1
    assert sign_flip_p(np.zeros(5)) == 1
    assert sign_flip_p(np.array([0.4])) == 1
    assert sign_flip_p(np.ones(30)) == 1 / 10_001  # no random flip of 10,000 is as far from 0


def test_a_small_difference_on_every_object_is_significant_although_the_intervals_overlap():
    parts = some_objects(count=18)
    better = [[value + 0.02 for value in part] for part in parts]
    a, b = measure_of(better), measure_of(parts)
    found = compare([a], [b])
    assert found.value == pytest.approx(0.02)
    assert 0.019 < found.low <= found.high < 0.021
    assert found.p == pytest.approx(2 / 2**18)
    assert summarise([a]).low[0] < summarise([b]).high[0] - 0.1


def of_choices(*values):
    """Return a measure of each choice: its objects differ from the value by 0.1 in either direction."""
    numbers = ((0, 1), (1, 2), (0, 2))
    return [
        Measure(np.array([[value - 0.1], [value + 0.1], [value + 0.1]]), np.array([a, b, b]), np.array([0.25]), "four")
        for value, (a, b) in zip(values, numbers, strict=True)
    ]


def test_an_interval_over_choices_is_the_corrected_resampled_t_interval():
    found = summarise_splits(of_choices(0.5, 0.6, 0.7), ratio=1.0)
    # s^2 = .01; (1 / 3 + 1) s^2 = .01333; t of 2 degrees of freedom at .975: 4.30265
    half = 4.30265 * np.sqrt((1 / 3 + 1) * 0.01)
    assert found.value == [pytest.approx(0.6)]
    assert found.low == [pytest.approx(0.6 - half, abs=1e-5)]
    assert found.high == [1.0]  # .6 + .4968, limited to 1
    assert np.ravel(found.repeats) == pytest.approx([0.5, 0.6, 0.7])
    assert (found.objects, found.queries, found.few_objects) == (3, 9, True)
    difference = compare_splits(of_choices(0.5, 0.6, 0.7), of_choices(0.4, 0.4, 0.4), ratio=1.0)
    assert difference.value == pytest.approx(0.2)
    assert difference.low == pytest.approx(0.2 - half, abs=1e-5)
    # t = .2 / sqrt(.01333) = 1.7321; of 2 degrees of freedom both tails beyond it have 1 - t / sqrt(t^2 + 2)
    assert difference.p == pytest.approx(1 - 1.7320508 / np.sqrt(5))
    with pytest.raises(BadInput, match="needs at least two splits; got 1"):
        summarise_splits(of_choices(0.5, 0.6, 0.7)[:1], ratio=1.0)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (0, 10, 0.0, 0.3084971078),  # 1 - 0.025 ** (1 / 10)
        (10, 10, 0.6915028922, 1.0),
        (4, 20, 0.0573, 0.4366),  # four digits in printed tables of the method
    ],
)
def test_the_interval_equals_that_of_clopper_and_pearson(successes, trials, low, high):
    assert binomial_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


def test_groups_count_as_fewer_answers_the_more_they_differ():
    """Ten groups of 50, five of them all wrong: by hand the design effect is 50 * 10 / 9, so 9 answers remain.

    4.5 of these are right. As 500 independent answers, the interval would be seven times too narrow.
    """
    low, high = grouped_interval([[True] * 50] * 5 + [[False] * 50] * 5)
    assert binomial_interval(4, 9)[0] < low < binomial_interval(5, 9)[0]
    assert binomial_interval(4, 9)[1] < high < binomial_interval(5, 9)[1]
    naive = binomial_interval(250, 500)
    assert high - low > 7 * (naive[1] - naive[0])
    assert grouped_interval([[True, False]] * 10) == pytest.approx(binomial_interval(10, 20))
    assert grouped_interval([[True] * 7, [True] * 5]) == binomial_interval(12, 12)
    assert grouped_interval([[True] * 3 + [False]]) == binomial_interval(3, 4)
    assert grouped_interval([]) == (0, 1)
