"""The fit of the calibration of reference touches."""

import dataclasses

import numpy as np
import pytest

from retrieval.model.references import reference_similarity
from retrieval.training.calibration import ScoredTouches, fit_references


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
    near, far = (
        fit_references(reference_touches(noise=0.1)),
        fit_references(reference_touches(noise=50.0)),
    )
    assert near.touch_only.slope > 5 > far.touch_only.slope
    assert near.weight * near.with_photos.slope > 5 * far.weight * far.with_photos.slope
    assert (near.objects, near.touches) == (10, 20)  # the second half of four touches each


def test_without_photos_only_the_touches_are_fitted():
    found = fit_references(reference_touches(photos=False))
    assert found.with_photos is None
    assert found.weight is None
    assert found.touch_only.slope > 1


def test_too_few_objects_touches_or_dimensions_give_no_calibration():
    assert fit_references(reference_touches(objects=2)) is None
    assert fit_references(reference_touches(touches=1)) is None
    touches = reference_touches()
    assert fit_references(dataclasses.replace(touches, touch_embeddings=touches.touch_embeddings[:, :0])) is None


@pytest.mark.parametrize("references", [1, 3])
def test_one_reference_and_three_are_both_calibrated(references):
    """On other objects, the mean probability of the best object equals its accuracy."""
    calibration = fit_references(reference_touches(objects=80, touches=8, noise=0.2, photos=False))
    others = reference_touches(objects=80, touches=8, noise=0.2, photos=False, seed=1)
    embeddings = others.touch_embeddings.reshape(80, 8, -1)
    shown, queries = embeddings[:, :references].reshape(80 * references, -1), embeddings[:, 4:].reshape(320, -1)
    near = reference_similarity(queries @ shown.T, np.arange(80) * references)
    ratios = np.array([calibration.touch_only.log_ratio(row, 1) for row in near])
    likelihoods = np.exp(ratios - ratios.max(1, keepdims=True))
    confidence = (likelihoods.max(1) / likelihoods.sum(1)).mean()
    accuracy = (ratios.argmax(1) == np.repeat(np.arange(80), 4)).mean()
    assert confidence == pytest.approx(accuracy, abs=0.1)
