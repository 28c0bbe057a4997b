"""What reference touches are worth, by hand."""

import dataclasses
import json
import math

import numpy as np
import pytest

from retrieval.errors import BadInput
from retrieval.model.posterior import JudgedTouches
from retrieval.model.references import (
    SHARPNESS,
    FeltTouches,
    ReferenceWorth,
    fit_references,
    nearness,
    touch_codes,
)
from tests.referenced import WORTH


def test_one_reference_says_its_cosine_and_a_copy_of_it_nothing_more():
    cosines = np.float32([[0.3, -0.2], [0.9, 0.1]])
    one = nearness(cosines, np.array([0, 1]))
    np.testing.assert_allclose(one, cosines, atol=1e-7)
    copied = nearness(cosines[:, [0, 0, 0, 1]], np.array([0, 3]))
    np.testing.assert_allclose(copied, cosines, atol=1e-7)


def test_several_references_are_averaged_as_likelihoods_are():
    """By two plain loops, over objects with one, three and two references."""
    cosines = np.random.default_rng(0).uniform(-1, 1, (4, 6)).astype(np.float32)
    parts = ([0], [1, 2, 3], [4, 5])
    for grasp, row in enumerate(nearness(cosines, np.array([0, 1, 4]))):
        for part, got in zip(parts, row, strict=True):
            mean = sum(math.exp(SHARPNESS * float(cosines[grasp, place])) for place in part) / len(part)
            assert got == pytest.approx(math.log(mean) / SHARPNESS, abs=1e-6)


def test_codes_are_the_end_of_halves_at_norm_one():
    halves = np.float16([[9, 9, 3, 4], [9, 9, 0, -2]])
    np.testing.assert_allclose(touch_codes(halves, 2), [[0.6, 0.8], [0, -1]], atol=1e-6)
    assert touch_codes(halves, 4).shape == (2, 0)


def test_what_they_are_worth_is_stored_and_read_again():
    assert ReferenceWorth.from_dict(json.loads(json.dumps(WORTH.to_dict()))) == WORTH
    bare = dataclasses.replace(WORTH, weight=None, beside=None)
    assert ReferenceWorth.from_dict(bare.to_dict()) == bare


@pytest.mark.parametrize(
    "change",
    [{"weight": math.inf}, {"weight": -1.0}, {"weight": None}, {"objects": "many"}, {"alone": {}}, {"more": 1}],
)
def test_what_is_no_worth_is_refused(change):
    with pytest.raises(BadInput):
        ReferenceWorth.from_dict(WORTH.to_dict() | change)


def felt(objects=10, touches=4, noise=0.3, photos=True, seed=0):
    """Codes around a direction of each object, and photos whose logits say a little."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), touches)
    codes = rng.normal(size=(objects, 16))[owner] + 4 * noise * rng.normal(size=(len(owner), 16))
    codes = (codes / np.linalg.norm(codes, axis=1, keepdims=True)).astype(np.float32)
    photo_owner = np.arange(objects if photos else 0)
    logits = rng.normal(size=(len(owner), len(photo_owner))) + (owner[:, None] == photo_owner)
    return FeltTouches(JudgedTouches(logits, owner, photo_owner, np.zeros(logits.shape, bool)), codes)


def test_near_touches_weigh_much_and_noise_weighs_little():
    near, far = fit_references(felt(noise=0.1)), fit_references(felt(noise=50.0))
    assert near.alone.slope > 5 > far.alone.slope
    assert near.weight * near.beside.slope > 5 * far.weight * far.beside.slope
    assert (near.objects, near.touches) == (10, 20)  # the last half of four touches each


def test_without_photos_the_touches_alone_are_fitted():
    found = fit_references(felt(photos=False))
    assert found.beside is None
    assert found.weight is None
    assert found.alone.slope > 1


def test_too_few_objects_or_touches_or_numbers_teach_nothing():
    assert fit_references(felt(objects=2)) is None
    assert fit_references(felt(touches=1)) is None
    given = felt()
    assert fit_references(dataclasses.replace(given, codes=given.codes[:, :0])) is None


@pytest.mark.parametrize("references", [1, 3])
def test_one_reference_is_believed_no_more_and_three_no_less_than_they_tell(references):
    """On other objects: how sure the best is said to be, and how often it is right."""
    worth = fit_references(felt(objects=80, touches=8, noise=0.2, photos=False))
    given = felt(objects=80, touches=8, noise=0.2, photos=False, seed=1)
    codes = given.codes.reshape(80, 8, -1)
    shown, asking = codes[:, :references].reshape(80 * references, -1), codes[:, 4:].reshape(320, -1)
    near = nearness(asking @ shown.T, np.arange(80) * references)
    ratios = np.array([worth.alone.log_ratio(row, 1) for row in near])
    shares = np.exp(ratios - ratios.max(1, keepdims=True))
    told = (shares.max(1) / shares.sum(1)).mean()
    right = (ratios.argmax(1) == np.repeat(np.arange(80), 4)).mean()
    assert told == pytest.approx(right, abs=0.1)
