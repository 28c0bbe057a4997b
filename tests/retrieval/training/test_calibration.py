"""Calibration: posterior, reference touches, and verification, whose rates hold over a whole sequence of grasps."""

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from _touch_retrieval.documents import typed
from retrieval.data.dataset import Grasp
from retrieval.errors import BadInput
from retrieval.model.posterior import SLOPE_BOUNDS, Posterior
from retrieval.model.references import reference_similarity
from retrieval.model.verification import (
    MAX_GRASPS,
    QUANTILES,
    VerificationCalibration,
)
from retrieval.training.calibration.opening import fit_opening
from retrieval.training.calibration.posterior import fit_posterior
from retrieval.training.calibration.references import fit_references
from retrieval.training.calibration.scores import ScoredTouches
from retrieval.training.calibration.verification import fit_verification, verification_sequences

# Posterior -------------------------------------------------------------------------------------------------


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


def test_the_fit_recovers_planted_parameters():
    true = normal_logits(300, 1, 1, apart=2.5, alike=0)
    found = fit_posterior(dataclasses.replace(true, logits=4 * true.logits + 10))  # log ratio = logit / 4 - 10 / 4
    assert found.slope == pytest.approx(1 / 4, rel=0.1)
    for log_ratio in (-1.0, 0.0, 2.0):
        assert found.slope * (4 * log_ratio + 10) + found.offset == pytest.approx(log_ratio, abs=0.3)
    assert found.dependence == 1.0  # single grasps do not determine it


def test_the_fit_recognises_independent_grasps_and_equal_ones():
    apart, alike = (fit_posterior(normal_logits(100, 2, 1, apart=1.5, alike=alike)) for alike in (0, 1))
    assert apart.dependence < 0.12
    assert alike.dependence > 0.9
    assert (apart.slope, alike.slope) == pytest.approx((1, 1), abs=0.15)


def test_logits_without_errors_have_a_finite_slope():
    owner = np.arange(20)
    found = fit_posterior(ScoredTouches(10 * np.eye(20) - 5, owner, owner, np.zeros((20, 20), dtype=bool)))
    assert SLOPE_BOUNDS[0] < found.slope < 3
    logits = [5.0] + [-5.0] * 18
    assert 0.5 < found.probabilities_given(logits, found.mass(logits)).objects[0] < 1


def test_a_photo_of_the_touchs_own_grasp_never_counts():
    scored = normal_logits(30, 2, 2, apart=2, alike=0)
    own = np.eye(60, dtype=bool)
    hidden, plain = (
        dataclasses.replace(scored, own=own, logits=np.where(own, value, scored.logits)) for value in (1e6, 0.0)
    )
    assert fit_posterior(hidden) == fit_posterior(plain)


def test_two_objects_are_too_few_to_fit_on():
    owner = np.array([0, 1])
    with pytest.raises(BadInput, match="at least three objects"):
        fit_posterior(ScoredTouches(np.eye(2), owner, owner, np.zeros((2, 2), dtype=bool)))


# Reference touches -------------------------------------------------------------------------------------------


def reference_touches(objects=10, touches=4, noise=0.3, photos=True, seed=0):
    """Return embeddings around a direction of each object, and photos whose logits carry some information."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), touches)
    embeddings = rng.normal(size=(objects, 16))[owner] + 4 * noise * rng.normal(size=(len(owner), 16))
    embeddings = (embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)).astype(np.float32)
    photo_owner = np.arange(objects if photos else 0)
    logits = rng.normal(size=(len(owner), len(photo_owner))) + (owner[:, None] == photo_owner)
    return ScoredTouches(logits, owner, photo_owner, np.zeros(logits.shape, bool), embeddings)


def test_near_touches_get_a_large_weight_and_noise_a_small_one():
    near, far = (fit_references(reference_touches(noise=noise)) for noise in (0.1, 50.0))
    assert near.touch_only.slope > 5 > far.touch_only.slope
    assert near.weight * near.with_photos.slope > 5 * far.weight * far.with_photos.slope
    assert (near.objects, near.touches) == (10, 20)  # the second half of four touches each


def test_without_photos_only_the_touches_are_fitted():
    found = fit_references(reference_touches(photos=False))
    assert (found.with_photos, found.weight) == (None, None)
    assert found.touch_only.slope > 1


def test_too_few_objects_touches_or_dimensions_give_no_calibration():
    assert fit_references(reference_touches(objects=2)) is None
    assert fit_references(reference_touches(touches=1)) is None
    touches = reference_touches()
    assert fit_references(dataclasses.replace(touches, touch_embeddings=touches.touch_embeddings[:, :0])) is None


def test_one_reference_and_three_are_both_calibrated():
    """On other objects, the mean probability of the best object equals its accuracy."""
    touches, others = (reference_touches(80, touches=8, noise=0.2, photos=False, seed=seed) for seed in (0, 1))
    calibration, embeddings = fit_references(touches), others.touch_embeddings.reshape(80, 8, -1)
    for references in (1, 3):
        shown, queries = embeddings[:, :references].reshape(80 * references, -1), embeddings[:, 4:].reshape(320, -1)
        near = reference_similarity(queries @ shown.T, np.arange(80) * references)
        ratios = np.array([calibration.touch_only.log_ratio(row, 1) for row in near])
        likelihoods = np.exp(ratios - ratios.max(1, keepdims=True))
        confidence = (likelihoods.max(1) / likelihoods.sum(1)).mean()
        accuracy = (ratios.argmax(1) == np.repeat(np.arange(80), 4)).mean()
        assert confidence == pytest.approx(accuracy, abs=0.1)


def opened_grasps(objects=60, grasps=4, outliers=0.2, seed=0):
    """Return grasps with openings: within 1 % of the object's own one, or those of any object."""
    rng = np.random.default_rng(seed)
    own, every = (np.exp(rng.normal(3.4, 0.7, shape)) for shape in ((objects, 1), (objects, grasps)))
    same = own * np.exp(0.01 * rng.standard_cauchy((objects, grasps)).clip(-9, 9))
    openings = np.where(rng.random(same.shape) < outliers, every, same)
    return [
        Grasp(f"{name}-{number}", str(name), None, Path("photo"), (), (), opening_mm=float(opening))
        for name, row in enumerate(openings)
        for number, opening in enumerate(row)
    ]


def test_the_fit_of_openings_finds_their_width_and_the_part_that_says_nothing():
    found, plain = fit_opening(opened_grasps(300)), fit_opening(opened_grasps(300, outliers=0))
    for each in (found, plain):  # reference and query both differ from the object's own opening
        assert (each.mean, each.spread, each.width) == pytest.approx((3.4, 0.7, 0.02), rel=0.3)
    assert plain.floor < 0.06 < 0.2 < found.floor < 0.4
    assert (found.objects, found.touches) == (300, 600)


def test_openings_without_a_fit_or_a_difference_are_no_evidence():
    grasps = opened_grasps()
    assert fit_opening(grasps[:36]) is None  # nine objects
    assert fit_opening([dataclasses.replace(grasp, opening_mm=None) for grasp in grasps]) is None
    assert fit_opening([dataclasses.replace(grasp, opening_mm=0.03) for grasp in grasps]) is None  # metres
    assert fit_opening([dataclasses.replace(grasp, opening_mm=110.0) for grasp in grasps]) is None


# Verification ------------------------------------------------------------------------------------------------


POSTERIOR = Posterior(slope=1.0, offset=-2.0, dependence=0.5)


def scored_objects(objects, seed, grasps=MAX_GRASPS + 1):
    """Return match logits with one photo of each grasp: 3 for the own object, 0 for others, noise partly shared."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), grasps)
    of_objects = rng.normal(size=(objects, objects)) * 1.5
    logits = of_objects[owner][:, owner] + rng.normal(size=(len(owner), len(owner))) * 1.3
    logits += 3.0 * (owner[:, None] == owner)
    embeddings = rng.normal(size=(len(owner), 4))
    return ScoredTouches(logits, owner, owner, np.eye(len(owner), dtype=bool), embeddings, embeddings)


def plain_sequences(scored, seed=3):
    """Return log likelihood ratios (S, G, O) after 1 to MAX_GRASPS grasps of each object, by plain loops."""
    rng, objects = np.random.default_rng(seed), np.unique(scored.touch_owner)
    found = np.empty((len(objects), MAX_GRASPS, len(objects)))
    for name in objects:
        touches = rng.permutation(np.flatnonzero(scored.touch_owner == name))[:MAX_GRASPS]
        for count in range(1, MAX_GRASPS + 1):
            allowed, weight = ~scored.own[touches[:count]].any(0), POSTERIOR.weight(count)
            for other in objects:
                photos = np.flatnonzero((scored.photo_owner == other) & allowed)
                sums = scored.logits[np.ix_(touches[:count], photos)].sum(0)
                found[name, count - 1, other] = np.log(np.mean(np.exp(weight * sums))) + POSTERIOR.offset
    return found


@pytest.fixture(scope="module")
def fitted():
    return fit_verification([scored_objects(100, seed=0)], POSTERIOR)


def test_the_stated_false_accept_rate_holds_on_other_objects_whenever_the_decision_falls(fitted):
    """The naive quantile of single grasps, applied after each grasp, accepts more impostors over a sequence."""
    ratios, bounds = plain_sequences(scored_objects(60, seed=1)), fitted.bounds(0.02)
    impostor = ~np.eye(60, dtype=bool)
    assert 0.01 <= (ratios.max(1) >= bounds.accept)[impostor].mean() <= 0.03
    genuine = (ratios.max(1).diagonal() < bounds.accept).mean()
    assert bounds.false_rejects.low <= genuine <= bounds.false_rejects.high
    naive = np.quantile(ratios[:, 0][impostor], 0.98)
    assert (ratios.max(1) >= naive)[impostor].mean() > 0.03


def test_a_rate_that_the_objects_cannot_support_is_refused_with_the_number_that_would(fitted):
    small = dataclasses.replace(fitted, group_sizes=(20,))  # 190 pairs: 0.158, rounded up
    with pytest.raises(BadInput, match=r"0\.1 needs 25 validation objects; the model has 20, enough for 0\.16"):
        small.bounds(0.1)  # 30 errors need 300 pairs, which 25 objects have
    assert small.bounds(0.2).false_accepts.value == 0.2
    for objects in (21, 50, 200):  # the proposed rate is supported
        found = dataclasses.replace(fitted, group_sizes=(objects,))
        with pytest.raises(BadInput) as refused:
            found.bounds(1e-4)
        found.bounds(float(re.search(r"enough for ([\d.]+)", str(refused.value))[1]))


@pytest.mark.parametrize("far", [0, 0.6])
def test_an_impossible_rate_is_refused(fitted, far):
    with pytest.raises(BadInput, match=r"must be above 0 and at most 0\.5"):
        fitted.bounds(far)


def test_similar_impostors_are_the_objects_with_the_most_similar_photos():
    scored = scored_objects(40, seed=5)
    owner = scored.photo_owner
    embeddings = np.eye(20)[owner // 2]  # objects 2 k and 2 k + 1 look alike
    scored.logits[scored.touch_owner[:, None] // 2 == owner // 2] += 2.0  # the own object has 3 more
    bounds = fit_verification([dataclasses.replace(scored, photo_embeddings=embeddings)], POSTERIOR).bounds(0.1)
    assert 3 * bounds.false_accepts.value < bounds.similar_false_accepts.value < 0.8
    assert bounds.false_rejects.value < 0.1


def test_too_few_objects_or_grasps_give_no_calibration():
    assert fit_verification([scored_objects(19, seed=0)], POSTERIOR) is None
    assert fit_verification([scored_objects(30, seed=0, grasps=MAX_GRASPS)], POSTERIOR) is None


def test_objects_of_two_groups_are_not_compared_with_each_other():
    first, second = scored_objects(50, seed=0), scored_objects(50, seed=6)
    both = fit_verification([first, second], POSTERIOR)
    assert (both.group_sizes, both.objects, both.pairs) == ((50, 50), 100, 2 * 50 * 49 // 2)
    parts = [verification_sequences(part, POSTERIOR) for part in (first, second)]
    level = np.quantile(np.concatenate([part.impostor.ravel() for part in parts]), 0.95)
    assert both.bounds(0.05).accept == pytest.approx(level, abs=0.02)
    ratios = np.concatenate([part.ratios for part in parts])
    assert both.genuine[1] == pytest.approx(np.quantile(ratios[:, :2].max(1), QUANTILES))
    assert both.lowest == pytest.approx(np.quantile(ratios[:, :-1].min(1), QUANTILES))  # the last grasp decides
    with pytest.raises(BadInput, match=r"0\.01 needs 111 validation objects; the model has 100"):
        both.bounds(0.01)  # 3,000 pairs: two groups of 55.5 objects


def test_the_document_of_a_calibration_gives_the_same_calibration(fitted):
    document = json.loads(json.dumps(dataclasses.asdict(fitted)))
    assert typed(document, VerificationCalibration, "verification", complete=True) == fitted
    with pytest.raises(BadInput, match="verification must have"):
        VerificationCalibration(**document | {"impostors": [1.0]})


def test_a_refused_touch_is_no_evidence_for_an_object():
    scored = scored_objects(30, seed=0)
    refused = np.arange(len(scored.touch_owner)) % 20 == 0
    logits = scored.without_evidence(refused).logits
    assert np.unique(logits[refused]).tolist() == [np.median(scored.logits)]
    np.testing.assert_array_equal(logits[~refused], scored.logits[~refused])


def test_refused_touches_are_false_rejects():
    scored = scored_objects(100, seed=0)
    every = fit_verification([scored], POSTERIOR).bounds(0.1)
    refused = np.random.default_rng(0).random(len(scored.touch_owner)) < 0.2
    checked = fit_verification([scored], POSTERIOR, refused=[refused]).bounds(0.1)
    assert (checked.accept, checked.false_accepts) == (every.accept, every.false_accepts)
    assert checked.accepted[0] == pytest.approx(0.8 * every.accepted[0], abs=0.03)
