"""The fit of the posterior recovers planted parameters."""

import math

import numpy as np
import pytest

from retrieval.errors import BadInput
from retrieval.model.posterior import SLOPE_BOUNDS, Posterior
from retrieval.training.calibration import ScoredTouches, fit_posterior

ADDING = Posterior(slope=1.0, offset=0.0, dependence=0.0)


def probabilities(posterior, logits, grasps=1, *, none_prior=0.5, unscored=0, sample=()):
    """Return the posterior over objects with these logits, unscored objects, and none."""
    mass = posterior.mass(logits, grasps, unscored=unscored, sample=sample)
    return posterior.probabilities_given(logits, mass, grasps, none_prior)


def normal_logits(objects, touches, photos, apart, alike, seed=0):
    """Return log likelihood ratios of two normal distributions, calibrated as they are.

    apart: distance of the distributions in standard deviations. alike: fraction of the noise of a touch that all
    touches of its object have in common.
    """
    rng = np.random.default_rng(seed)
    owner, photo_owner = np.repeat(np.arange(objects), touches), np.repeat(np.arange(objects), photos)
    same = owner[:, None] == photo_owner
    common = rng.normal(size=(objects, len(photo_owner)))[owner]
    noise = math.sqrt(alike) * common + math.sqrt(1 - alike) * rng.normal(size=same.shape)
    logits = apart * (noise + np.where(same, apart / 2, -apart / 2))
    return ScoredTouches(logits, owner, photo_owner, np.zeros(same.shape, dtype=bool))


def changed(scored, scale, shift):
    return ScoredTouches(scale * scored.logits + shift, scored.touch_owner, scored.photo_owner, scored.own)


def test_the_fit_recovers_planted_parameters():
    true = normal_logits(300, 1, 1, apart=2.5, alike=0)
    found = fit_posterior(changed(true, 4, 10))  # log ratio = logit / 4 - 10 / 4
    assert found.slope == pytest.approx(1 / 4, rel=0.1)
    for log_ratio in (-1.0, 0.0, 2.0):
        assert found.slope * (4 * log_ratio + 10) + found.offset == pytest.approx(log_ratio, abs=0.3)
    assert found.dependence == 1.0  # single grasps do not determine it


def test_the_fit_recognises_independent_grasps_and_equal_ones():
    apart = fit_posterior(normal_logits(100, 2, 1, apart=1.5, alike=0))
    assert apart.dependence < 0.12
    alike = fit_posterior(normal_logits(100, 2, 1, apart=1.5, alike=1))
    assert alike.dependence > 0.9
    assert (apart.slope, alike.slope) == pytest.approx((1, 1), abs=0.15)


def test_logits_without_errors_have_a_finite_slope():
    owner = np.arange(20)
    scored = ScoredTouches(np.where(np.eye(20, dtype=bool), 5.0, -5.0), owner, owner, np.zeros((20, 20), dtype=bool))
    found = fit_posterior(scored)
    assert SLOPE_BOUNDS[0] < found.slope < 3
    assert 0.5 < probabilities(found, [5.0] + [-5.0] * 18).objects[0] < 1


def test_a_photo_of_the_touchs_own_grasp_never_counts():
    scored = normal_logits(30, 2, 2, apart=2, alike=0)
    own = np.zeros_like(scored.own)
    own[np.arange(60), np.arange(60)] = True
    with_secret = np.where(own, 1e6, scored.logits)
    hidden = ScoredTouches(with_secret, scored.touch_owner, scored.photo_owner, own)
    plain = ScoredTouches(np.where(own, 0.0, scored.logits), scored.touch_owner, scored.photo_owner, own)
    assert fit_posterior(hidden) == fit_posterior(plain)


def test_two_objects_are_too_few_to_fit_on():
    owner = np.array([0, 1])
    with pytest.raises(BadInput, match="at least three objects"):
        fit_posterior(ScoredTouches(np.eye(2), owner, owner, np.zeros((2, 2), dtype=bool)))
