"""Features of frozen towers: their values, the cache, and the variants of controls."""

import dataclasses
import shutil

import cv2
import numpy as np
import pytest
import torch

from retrieval.data.dataset import load_grasps
from retrieval.data.pairs import PairSampler
from retrieval.data.resize import resize
from retrieval.errors import NumericalError
from retrieval.training import features as features_module
from retrieval.training.batches import TrainedFeatures
from retrieval.training.controls import low_pass, photo_margin
from retrieval.training.features import encode_recording, features_by_image
from retrieval.training.initial_weights import build_matcher
from tests.conftest import TINY


@pytest.fixture(scope="module")
def grasps(recording):
    return load_grasps(recording)[:9]


@pytest.fixture(scope="module")
def matcher():
    torch.manual_seed(0)
    return build_matcher(TINY)


@pytest.fixture(scope="module")
def plain(grasps, matcher):
    return encode_recording(grasps, matcher, TINY, None)


@pytest.fixture
def encode(grasps, tmp_path, monkeypatch):
    """A function that encodes with a cache, and returns the features and the images that went through the towers."""
    counts = []
    for name in ("touch_features", "photo_features"):
        real = getattr(features_module, name)
        counting = lambda matcher, items, real=real: (counts.append(len(items := list(items))), real(matcher, items))[1]  # noqa: E731
        monkeypatch.setattr(features_module, name, counting)

    def encoded(matcher, config=TINY, items=grasps, cache=tmp_path, **options):
        counts.clear()
        return encode_recording(items, matcher, config, cache, **options), sum(counts)

    return encoded


def same(one, other):
    """Compare features of batches of two sizes: float32, summed in another order."""
    np.testing.assert_allclose(one.touch, other.touch, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(one.photo, other.photo, rtol=1e-4, atol=1e-5)


def test_a_row_contains_the_tower_features_of_its_grasp_and_is_found_by_grasp_and_photo(grasps, matcher, plain):
    assert plain.grasp_ids == tuple(grasp.grasp_id for grasp in grasps)
    assert plain.object_ids == tuple(grasp.object_id for grasp in grasps)
    known, load = features_by_image(grasps[2:6], plain, torch.device("cpu")), TINY.preprocessing
    assert set(known) == {each for grasp in grasps[2:6] for each in (grasp.grasp_id, grasp.photo)}
    fingers = np.stack([load.load_touch(path) for path in grasps[5].touches])
    with torch.inference_mode():
        touch = matcher.touch_tower(torch.from_numpy(fingers).permute(0, 3, 1, 2))
        photo = matcher.photo_tower(torch.from_numpy(load.load_photo(grasps[5].photo)[None]).permute(0, 3, 1, 2))
    # float32, summed in another order in a batch of another size
    np.testing.assert_allclose(known[grasps[5].grasp_id], touch.flatten(), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(known[grasps[5].photo], photo[0], rtol=1e-4, atol=1e-5)


def test_only_images_that_the_cache_lacks_are_encoded(grasps, matcher, plain, encode):
    assert encode(matcher, items=grasps[2:6])[1] == 2 * 4
    larger, count = encode(matcher)
    assert count == 2 * 5
    same(larger, plain)
    again, count = encode(matcher)
    assert (count, again.digest) == (0, larger.digest)
    torch.manual_seed(1)
    assert encode(build_matcher(TINY))[1] == 2 * 9  # other weights
    smaller = dataclasses.replace(TINY, preprocessing=dataclasses.replace(TINY.preprocessing, touch_px=40))
    assert encode(matcher, smaller)[1] == 2 * 9
    shared = [dataclasses.replace(grasp, photo_file=grasps[0].photo) for grasp in grasps[:3]]
    features, count = encode(matcher, items=shared, cache=None)
    assert count == 3 + 1
    np.testing.assert_array_equal(features.photo[0], features.photo[2])


def test_an_interrupted_run_keeps_its_finished_batches(matcher, plain, encode, monkeypatch):
    monkeypatch.setattr(features_module, "_BATCH", 4)
    with monkeypatch.context() as during:
        during.setattr("retrieval.data.preprocessing.Preprocessing.load_photo", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            encode(matcher)
    resumed, count = encode(matcher)
    assert count == 9  # the photos
    same(resumed, plain)


def test_a_variant_changes_only_its_modality(grasps, matcher, encode):
    whole, count = encode(matcher)
    assert count == 9 + 9
    for variant in ("low_pass", "no_contact"):
        made, count = encode(matcher, touch_variant=variant)
        assert count == 9
        np.testing.assert_array_equal(made.photo, whole.photo)
        assert np.abs(made.touch - whole.touch).max() > 0.01
    frames = [dataclasses.replace(grasp, touches=grasp.backgrounds) for grasp in grasps]
    np.testing.assert_array_equal(made.touch, encode(matcher, items=frames, cache=None)[0].touch)
    margin, count = encode(matcher, photo_variant="margin")
    assert count > 0
    np.testing.assert_array_equal(margin.touch, whole.touch)
    assert np.abs(margin.photo - whole.photo).max() > 0.01
    touches, count = encode(matcher, touch_variant="low_pass", photo_variant="none")
    assert (count, touches.photo.shape) == (0, (9, 0))


@pytest.mark.parametrize("size", [(240, 320), (32, 48), (7, 9), (1, 3)])
def test_low_pass_equals_a_gaussian_blur_reduced_and_enlarged_again(size):
    image = np.random.default_rng(0).random((*size, 3), dtype=np.float32)
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), size[1] / 10), dtype=np.float32)
    np.testing.assert_allclose(low_pass(image), resize(resize(smooth, (6, 8)), size), atol=2e-6)  # float32 sums


def test_the_margin_of_a_photo_remains_and_the_inside_is_removed():
    noise = np.random.default_rng(1).random((80, 160, 3), dtype=np.float32)
    found = photo_margin(noise)
    np.testing.assert_array_equal(found[:10], noise[:10])
    np.testing.assert_array_equal(found[:, :20], noise[:, :20])
    assert len(np.unique(found[10:-10, 20:-20].reshape(-1, 3), axis=0)) == 1
    assert photo_margin(noise[:1, :1]).shape == (1, 1, 3)


@pytest.mark.parametrize("part", ["touch", "photo"])
def test_a_feature_that_is_not_finite_is_an_error_that_names_its_grasp(part, plain):
    invalid = getattr(plain, part).copy()
    invalid[1, ..., 0] = np.nan if part == "touch" else -np.inf
    with pytest.raises(NumericalError, match=f"{part} features must be finite; grasp {plain.grasp_ids[1]} has"):
        dataclasses.replace(plain, **{part: invalid})


def test_the_touches_and_photos_of_an_object_are_mirrored_together(grasps, tmp_path):
    """A touch is brighter at its upper side, a photo at its left side; a mirrored one at the other side."""
    ramp = np.linspace(255, 0, 48).astype(np.uint8)
    left = np.repeat(np.tile(ramp, (48, 1))[..., None], 3, axis=2)
    cv2.imwrite(str(tmp_path / "touch.png"), left.transpose(1, 0, 2))
    cv2.imwrite(str(tmp_path / "photo.png"), left)
    items = []
    for grasp in grasps:
        photo = shutil.copy(tmp_path / "photo.png", tmp_path / f"{grasp.grasp_id}.png")
        items.append(dataclasses.replace(grasp, touches=(tmp_path / "touch.png",) * 2, photo_file=photo))
    config = dataclasses.replace(TINY, training=dataclasses.replace(TINY.training, augment=True, workers=0))
    sampler = PairSampler(items, seed=0, positives=2, negatives=2, share_photos=True)
    source, seen = TrainedFeatures(config, torch.device("cpu")), set()
    for loaded in source.batches(None, [(step, sampler.batch(step, 4)) for step in range(4)]):
        rows, columns = loaded.touches.mean((1, 2, 4)), loaded.photos.mean((1, 2))
        is_flipped = (rows[:, :8].mean(1) < rows[:, -8:].mean(1)).tolist()
        is_mirrored = (columns[:, :8].mean(1) < columns[:, -8:].mean(1)).tolist()
        sides = [zip(loaded.batch.touch_objects, is_flipped, strict=True)]
        sides.append(zip(loaded.batch.photo_objects, is_mirrored, strict=True))
        known = {}
        for number, side in (pair for pairs in sides for pair in pairs):
            assert known.setdefault(int(number), side) == side
            seen.add(side)
    assert seen == {False, True}
