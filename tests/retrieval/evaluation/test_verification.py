"""Error rates of verification on test objects: hand-made scores, refusals, and a whole evaluation."""

from types import SimpleNamespace

import numpy as np
import pytest

from retrieval.evaluation.queries import MethodScores, Queries
from retrieval.evaluation.results import Rate
from retrieval.evaluation.verification import equal_error_rate, false_rejects, verification_rates
from retrieval.model.posterior import Posterior

GENUINE = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
IMPOSTORS = np.array([0.0, 0.5, 1.5, 2.5, -1.0, -2.0, -3.0, -4.0, -5.0, -6.0])


@pytest.mark.parametrize(
    ("far", "expected"),
    [
        (0.1, 1 / 5),  # the threshold is above 1.5: one impostor of ten is accepted, 1.0 is rejected
        (0.2, 0.0),  # above 0.5
        (0.05, 2 / 5),  # above 2.5: no impostor is accepted, 1.0 and 2.0 are rejected
    ],
)
def test_the_false_reject_rate_is_that_of_the_lowest_threshold_that_keeps_the_false_accept_rate(far, expected):
    assert false_rejects(far, GENUINE, IMPOSTORS) == pytest.approx(expected)
    assert false_rejects(far, np.ones(4), np.ones(10)) == 1.0  # a tie with a rejected impostor is rejected


def test_the_equal_error_rate_lies_where_both_rates_are_equal():
    # Thresholds 1.5 and 2.0: FAR 2/10 and 1/10, FRR 1/5 and 1/5.
    assert equal_error_rate(GENUINE, IMPOSTORS) == pytest.approx(0.2)
    assert equal_error_rate(np.array([5.0, 6.0]), IMPOSTORS) == 0.0
    assert equal_error_rate(np.zeros(3), np.zeros(7)) == 0.5  # a constant score is at chance


POSTERIOR = Posterior(slope=1.0, offset=0.0, dependence=0.5)


def evaluated(objects, grasps=7, gap=0.0, posterior=POSTERIOR, validation=0):
    """Score touches of test objects, after some validation objects, with one photo of each grasp.

    Objects 2 k and 2 k + 1 have equal embeddings. Match logits are noise of deviation 1, higher by `gap` for the right
    object and for its similar object.
    """
    rng = np.random.default_rng(0)
    owner = np.repeat(np.arange(objects), grasps)
    places, names = np.arange(len(owner)), tuple(f"object-{number:03}" for number in range(objects))
    parts = ("validation",) * validation + ("test",) * (objects - validation)
    queries = Queries(places, places, places, owner, owner, names, parts, {})
    logits = rng.normal(size=(len(owner),) * 2) + gap * (owner[:, None] // 2 == owner // 2)
    # The embedding of a photo is its features: the photo encoder returns them.
    features = SimpleNamespace(photo=np.eye(objects // 2, dtype=np.float32)[owner // 2])
    matcher = SimpleNamespace(photo_encoding=lambda photo: SimpleNamespace(embedding=photo))
    checkpoint = SimpleNamespace(matcher=matcher, posterior=posterior)
    scores = MethodScores(queries, logits.astype(np.float32), {}, None, 0)
    return verification_rates(scores, features, checkpoint)


def test_each_kind_of_impostor_has_rates_or_the_number_of_objects_that_would_be_enough():
    found = evaluated(50, gap=4.0)  # 1,225 pairs, enough for a FAR of 2.4 %
    assert set(found) == {"random", "similar"}
    for kind, needed in (("random", [25, 78, 246]), ("similar", [300, 3000, 30000])):  # 300 pairs of 25: 30 errors
        assert list(found[kind]) == ["1", "2", "3", "5"]
        for one in found[kind].values():
            assert (one.objects, one.sequences) == (50, 400)
            assert list(one.frr) == ["0.1", "0.01", "0.001"]
            assert [rate.objects_needed for rate in one.frr.values()] == needed
            assert [rate.value is not None for rate in one.frr.values()] == [kind == "random", False, False]
    assert found["random"]["1"].frr["0.01"] == Rate(None, None, None, 78)


def test_a_rate_has_the_binomial_interval_with_each_object_as_one_trial():
    rate = evaluated(30, gap=20.0)["random"]["1"].frr["0.1"]
    assert rate.value == 0
    assert (rate.low, rate.high) == (0, pytest.approx(1 - 0.025 ** (1 / 30)))


def test_numbers_of_grasps_that_the_objects_lack_are_left_out():
    assert list(evaluated(20, grasps=4)["random"]) == ["1", "2", "3"]  # one more grasp gives the photo
    assert evaluated(20, grasps=1) is None
    assert evaluated(2) is None


def test_a_head_without_posterior_gets_that_of_the_validation_objects():
    assert evaluated(30, gap=4.0, posterior=None, validation=2) is None  # a posterior needs three
    found = evaluated(40, gap=4.0, posterior=None, validation=10)["random"]["1"]
    assert found.objects == 30
    assert found.frr["0.1"].value < 0.1
