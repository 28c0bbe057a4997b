"""Verification: thresholds keep the stated false-accept rate over a whole sequence of grasps."""

import dataclasses
import json
import re

import numpy as np
import pytest

from _touch_retrieval.documents import typed
from retrieval.errors import BadInput
from retrieval.model.posterior import Posterior
from retrieval.model.verification import (
    ACCEPT,
    ANOTHER_GRASP,
    LEVELS,
    MAX_GRASPS,
    QUANTILES,
    REJECT,
    VerificationCalibration,
)
from retrieval.training.calibration import ScoredTouches, fit_verification, verification_sequences

POSTERIOR = Posterior(slope=1.0, offset=-2.0, dependence=0.5)
EMBEDDING_DIM = 4


def scored_objects(objects, seed, grasps=MAX_GRASPS + 1):
    """Return match logits of touches with one photo of each grasp: 3 for the own object, 0 for others, noise of 2.

    All grasps of an object share part of the noise with each photo's object, as in reality.
    """
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), grasps)
    of_objects = rng.normal(size=(objects, objects)) * 1.5
    logits = of_objects[owner][:, owner] + rng.normal(size=(len(owner), len(owner))) * 1.3
    logits += 3.0 * (owner[:, None] == owner)
    embeddings = rng.normal(size=(len(owner), EMBEDDING_DIM))
    return ScoredTouches(logits, owner, owner, np.eye(len(owner), dtype=bool), embeddings, embeddings)


def sequences(scored, seed=3):
    """Return log likelihood ratios (S, O) after 1 to MAX_GRASPS grasps of each object, by plain loops."""
    rng = np.random.default_rng(seed)
    objects = np.unique(scored.touch_owner)
    found, true = [], []
    for name in objects:
        touches = rng.permutation(np.flatnonzero(scored.touch_owner == name))[:MAX_GRASPS]
        rows = []
        for count in range(1, MAX_GRASPS + 1):
            weight = POSTERIOR.weight(count)
            row = []
            for other in objects:
                photos = [
                    photo
                    for photo in np.flatnonzero(scored.photo_owner == other)
                    if not scored.own[touches[:count], photo].any()
                ]
                sums = scored.logits[np.ix_(touches[:count], photos)].sum(0)
                row.append(np.log(np.mean(np.exp(weight * sums))) + POSTERIOR.offset)
            rows.append(row)
        found.append(rows)
        true.append(name)
    return np.array(found), np.array(true)


@pytest.fixture(scope="module")
def fitted():
    return fit_verification([scored_objects(100, seed=0)], POSTERIOR)


def test_the_stated_false_accept_rate_holds_on_other_objects_whenever_the_decision_falls(fitted):
    ratios, true = sequences(scored_objects(120, seed=1))
    bounds = fitted.bounds(0.02)
    impostor = np.ones(ratios[:, 0].shape, dtype=bool)
    impostor[np.arange(len(true)), true] = False
    accepted = (ratios.max(1) >= bounds.accept)[impostor].mean()
    assert 0.012 <= accepted <= 0.03
    genuine = (ratios.max(1)[np.arange(len(true)), true] < bounds.accept).mean()
    assert bounds.false_rejects.low <= genuine <= bounds.false_rejects.high


def test_a_threshold_for_one_grasp_accepts_too_many_impostors_over_a_sequence(fitted):
    """The naive way: the quantile of single grasps, applied after each grasp."""
    ratios, true = sequences(scored_objects(120, seed=1))
    impostor = np.ones(ratios[:, 0].shape, dtype=bool)
    impostor[np.arange(len(true)), true] = False
    naive = np.quantile(ratios[:, 0][impostor], 0.98)
    assert (ratios.max(1) >= naive)[impostor].mean() > 0.03 > 0.02


def test_a_rate_that_the_objects_cannot_support_is_refused_with_the_number_that_would():
    small = fit_verification([scored_objects(20, seed=2)], POSTERIOR)  # 190 pairs: 0.158, rounded up
    with pytest.raises(BadInput, match=r"0\.1 needs 25 validation objects; the model has 20, enough for 0\.16"):
        small.bounds(0.1)  # 30 errors need 300 pairs, which 25 objects have
    assert small.bounds(0.2).false_accepts.value == 0.2


@pytest.mark.parametrize("objects", [21, 40, 50, 120, 200])
def test_the_rate_that_a_refusal_proposes_is_supported(fitted, objects):
    calibration = dataclasses.replace(fitted, group_sizes=(objects,))
    with pytest.raises(BadInput) as refused:
        calibration.bounds(1e-4)
    calibration.bounds(float(re.search(r"enough for ([\d.]+)", str(refused.value))[1]))


@pytest.mark.parametrize("far", [0, 1, -0.1, 0.6, float("nan"), None])
def test_an_impossible_rate_is_refused(fitted, far):
    with pytest.raises(BadInput, match=r"must be above 0 and at most 0\.5"):
        fitted.bounds(far)


@pytest.mark.parametrize(
    ("ratios", "decision"),
    [
        ([5.0], ACCEPT),
        ([0.0], ANOTHER_GRASP),
        ([-9.0], REJECT),
        ([0.0, 5.0], ACCEPT),
        ([5.0, -9.0], ACCEPT),  # it was accepted after the first grasp
        ([0.0, 0.0, 0.0, 0.0], REJECT),  # no further grasp is possible
    ],
)
def test_a_decision_follows_the_two_bounds(fitted, ratios, decision):
    bounds = dataclasses.replace(fitted.bounds(0.05), accept=4.0, reject=-4.0)
    assert bounds.decide(np.array(ratios)) == decision


def test_similar_impostors_are_the_objects_with_the_most_similar_photos():
    scored = scored_objects(40, seed=5)
    owner = scored.photo_owner
    embeddings = np.eye(20)[owner // 2]  # objects 2 k and 2 k + 1 look alike
    scored.logits[scored.touch_owner[:, None] // 2 == owner // 2] += 3.0
    bounds = fit_verification([dataclasses.replace(scored, photo_embeddings=embeddings)], POSTERIOR).bounds(0.1)
    assert bounds.similar_false_accepts.value > 3 * bounds.false_accepts.value


def test_too_few_objects_or_grasps_give_no_calibration():
    assert fit_verification([scored_objects(19, seed=0)], POSTERIOR) is None
    assert fit_verification([scored_objects(30, seed=0, grasps=MAX_GRASPS)], POSTERIOR) is None


def test_objects_of_two_groups_are_not_compared_with_each_other():
    """Two folds of `retrieve adapt` have different maps, whose logits are not on one scale."""
    first, second = scored_objects(50, seed=0), scored_objects(50, seed=6)
    both = fit_verification([first, second], POSTERIOR)
    assert (both.group_sizes, both.objects, both.pairs) == ((50, 50), 100, 2 * 50 * 49 // 2)
    expected = [verification_sequences(part, POSTERIOR) for part in (first, second)]
    level = np.quantile(np.concatenate([part.impostor.ravel() for part in expected]), 0.95)
    assert both.bounds(0.05).accept == pytest.approx(level, abs=0.02)
    with pytest.raises(BadInput, match=r"0\.01 needs 111 validation objects; the model has 100"):
        both.bounds(0.01)  # 3,000 pairs: two groups of 55.5 objects


def test_the_document_of_a_calibration_gives_the_same_calibration(fitted):
    document = json.loads(json.dumps(dataclasses.asdict(fitted)))
    assert typed(document, VerificationCalibration, "verification", complete=True) == fitted
    assert len(document["impostors"]) == len(LEVELS)
    assert len(document["similar"]) == len(QUANTILES)
    with pytest.raises(BadInput, match="verification must have"):
        VerificationCalibration(**document | {"impostors": [1.0]})
    with pytest.raises(BadInput, match=r"verification.*objects"):
        VerificationCalibration(**document | {"group_sizes": [3]})
