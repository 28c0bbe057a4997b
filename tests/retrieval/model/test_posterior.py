"""The posterior: probabilities by hand, naive formulas that fail, and a fit that recovers planted parameters."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from retrieval.errors import BadInput, NumericalError
from retrieval.model.posterior import Posterior, require_prior

ADDING = Posterior(slope=1.0, offset=0.0, dependence=0.0)


def probabilities(posterior, logits, grasps=1, *, none_prior=0.5, unscored=0, sample=()):
    """Return the posterior over objects with these logits, unscored objects, and none."""
    mass = posterior.mass(logits, grasps, unscored=unscored, sample=sample)
    return posterior.probabilities_given(logits, mass, grasps, none_prior)


def test_probabilities_equal_those_calculated_by_hand():
    # Weights: none 1/2; objects 1/4 * 3 and 1/4; together 3/2.
    found = probabilities(ADDING, [math.log(3), 0.0], none_prior=0.5)
    assert found.none == pytest.approx(1 / 3)
    assert found.objects == pytest.approx([1 / 2, 1 / 6])
    # A prior of 1/5: 1/5, 4/10 * 3 and 4/10; together 9/5.
    found = probabilities(ADDING, [math.log(3), 0.0], none_prior=0.2)
    assert (found.none, *found.objects) == pytest.approx((1 / 9, 6 / 9, 2 / 9))
    # Four objects, two of them scored: 1/8 * 4 and 1/8; the two others like the sample, whose ratios 1 and 3 average 2.
    found = probabilities(ADDING, [math.log(4), 0.0], none_prior=0.5, unscored=2, sample=[0.0, math.log(3)])
    total = 4 / 8 + 4 / 8 + 1 / 8 + 2 * 2 / 8
    assert (found.none, found.unscored, *found.objects) == pytest.approx(
        [part / total for part in (0.5, 0.5, 0.5, 0.125)]
    )


@given(
    st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30),
    st.floats(0, 0.99),
    st.integers(1, 9),
    st.lists(st.floats(-1e6, 1e6), max_size=5),
)
def test_probabilities_add_up_to_one_and_have_the_order_of_the_logits(logits, prior, grasps, sample):
    posterior = Posterior(slope=0.7, offset=-0.3, dependence=0.6)
    found = probabilities(posterior, logits, grasps, none_prior=prior, unscored=7 if sample else 0, sample=sample)
    assert found.none + found.unscored + found.objects.sum() == pytest.approx(1)
    order = np.argsort(logits)
    assert (np.diff(found.objects[order]) >= 0).all()


def test_the_probability_if_present_equals_that_by_hand_for_any_prior_and_offset():
    # Weights 3 and 1, together 4.
    for offset, prior in ((0.0, 0.5), (-3.0, 0.9), (2.0, 0.0)):
        found = probabilities(Posterior(1.0, offset, 0.0), [math.log(3), 0.0], none_prior=prior)
        assert found.objects_if_present == pytest.approx([3 / 4, 1 / 4])
    # Four objects, two of them scored: weights 4 and 1; the two others weigh 2 each, the mean of the sample.
    found = probabilities(ADDING, [math.log(4), 0.0], unscored=2, sample=[0.0, math.log(3)])
    assert found.objects_if_present == pytest.approx([4 / 9, 1 / 9])
    # Two grasps: w = 1 / 1.5, so logits of 1.5 log 3 and 0 weigh 3 and 1.
    found = probabilities(Posterior(1.0, 0.0, 0.5), [1.5 * math.log(3), 0.0], 2)
    assert found.objects_if_present == pytest.approx([3 / 4, 1 / 4])


def test_where_none_rounds_to_one_the_probability_if_present_is_exact_and_the_quotient_is_nan():
    found = probabilities(ADDING, [-1000.0, -1001.0])
    assert found.none == 1.0
    with np.errstate(invalid="ignore"):
        assert np.isnan(found.objects / (1 - found.none)).all()
    assert found.objects_if_present == pytest.approx([1 / (1 + math.exp(-1)), 1 / (1 + math.e)])
    # Before that point the quotient has lost its digits: 1 - P(none) is a multiple of 1e-16.
    found = probabilities(ADDING, [-32.0, -33.0])
    exact = 1 / (1 + math.exp(-1))
    assert found.objects[0] / (1 - found.none) != pytest.approx(exact, rel=1e-3)
    assert found.objects_if_present[0] == pytest.approx(exact)


def test_an_objects_logit_averages_the_likelihoods_of_its_photos():
    posterior = Posterior(0.8, 0.3, 0.5)
    scores, owner, counts = np.array([2.0, -1.0, 0.5, 3.0]), np.array([0, 1, 0, 1]), np.array([2, 3])
    weight = 0.8 / 1.5
    expected = [
        math.log((math.exp(2 * weight) + math.exp(0.5 * weight)) / 2) / weight,
        math.log((math.exp(-weight) + math.exp(3 * weight) + 0) / 3) / weight,  # its third photo was not scored
    ]
    assert posterior.object_logits(scores, owner, counts, grasps=2) == pytest.approx(expected)
    # exp(900) is infinite in float64.
    assert posterior.object_logits([900.0, 900.0], np.array([0, 0]), np.array([2])) == pytest.approx([900.0])


def test_a_logit_that_is_not_finite_and_an_invalid_prior_are_refused():
    for bad in (math.nan, -math.inf):
        with pytest.raises(NumericalError, match="every logit must be finite"):
            probabilities(ADDING, [0.0, bad])
    for prior in (-0.1, 1.0, math.nan):
        with pytest.raises(BadInput, match="must be at least 0 and less than 1"):
            require_prior(prior)
