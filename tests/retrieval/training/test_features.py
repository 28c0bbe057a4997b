"""Features of frozen towers: their values, the cache, and the variants of controls."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from retrieval.data.dataset import load_grasps
from retrieval.data.resize import resize
from retrieval.errors import DatasetError, NumericalError
from retrieval.training.features import (
    PHOTO_VARIANTS,
    Features,
    encode_recording,
    features_by_image,
    low_pass,
    photo_margin,
)
from retrieval.training.initial_weights import build_matcher
from tests.conftest import TINY


@pytest.fixture(scope="module")
def grasps(recording):
    return load_grasps(recording)[:9]


@pytest.fixture(scope="module")
def matcher():
    torch.manual_seed(0)
    return build_matcher(TINY)


@pytest.fixture
def counted(monkeypatch):
    """Numbers of images that pass through the towers."""
    counts = {"touch_features": 0, "photo_features": 0}
    for name in counts:
        real = getattr(__import__("retrieval.training.features", fromlist=[name]), name)

        def counting(matcher, items, name=name, real=real):
            items = list(items)
            counts[name] += len(items)
            return real(matcher, items)

        monkeypatch.setattr(f"retrieval.training.features.{name}", counting)
    return counts


def test_a_row_contains_the_tower_features_of_its_grasp(grasps, matcher):
    features = encode_recording(grasps, matcher, TINY, None, quiet=True)
    assert features.grasp_ids == tuple(grasp.grasp_id for grasp in grasps)
    assert features.object_ids == tuple(grasp.object_id for grasp in grasps)
    load = TINY.preprocessing
    with torch.inference_mode():
        for row in (0, 5):
            fingers = np.stack([load.load_touch(path) for path in grasps[row].touches])
            photo = load.load_photo(grasps[row].photo)[None]
            touch = matcher.touch_tower(torch.from_numpy(fingers).permute(0, 3, 1, 2))
            encoded_photo = matcher.photo_tower(torch.from_numpy(photo).permute(0, 3, 1, 2))
            # float32, summed in another order in a batch of another size
            np.testing.assert_allclose(features.touch[row], touch, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(features.photo[row], encoded_photo[0], rtol=1e-4, atol=1e-5)


def test_a_second_run_reads_and_encodes_nothing(grasps, matcher, tmp_path, counted):
    first = encode_recording(grasps, matcher, TINY, tmp_path, quiet=True)
    assert counted == {"touch_features": 9, "photo_features": 9}
    again = encode_recording(grasps, matcher, TINY, tmp_path, quiet=True)
    assert counted == {"touch_features": 9, "photo_features": 9}
    assert again.digest == first.digest


def test_an_interrupted_run_keeps_its_finished_batches(grasps, matcher, tmp_path, counted, monkeypatch):
    whole = encode_recording(grasps, matcher, TINY, None, quiet=True)
    monkeypatch.setattr("retrieval.training.features._BATCH", 4)
    with monkeypatch.context() as during:
        during.setattr("retrieval.data.preprocessing.Preprocessing.load_photo", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            encode_recording(grasps, matcher, TINY, tmp_path, quiet=True)
    counted.update(touch_features=0, photo_features=0)
    resumed = encode_recording(grasps, matcher, TINY, tmp_path, quiet=True)
    assert counted == {"touch_features": 0, "photo_features": 9}
    np.testing.assert_allclose(resumed.touch, whole.touch, rtol=1e-4, atol=1e-5)  # batches of another size
    np.testing.assert_allclose(resumed.photo, whole.photo, rtol=1e-4, atol=1e-5)


def test_of_a_larger_recording_only_the_new_images_are_encoded(grasps, matcher, tmp_path, counted):
    encode_recording(grasps[2:6], matcher, TINY, tmp_path, quiet=True)
    every = encode_recording(grasps, matcher, TINY, tmp_path, quiet=True)
    assert counted == {"touch_features": 9, "photo_features": 9}
    expected = encode_recording(grasps, matcher, TINY, None, quiet=True)
    np.testing.assert_allclose(every.touch, expected.touch, rtol=1e-4, atol=1e-5)


def test_other_weights_or_preprocessing_are_encoded_again(grasps, matcher, tmp_path, counted):
    encode_recording(grasps, matcher, TINY, tmp_path, quiet=True)
    torch.manual_seed(1)
    smaller = dataclasses.replace(TINY, preprocessing=dataclasses.replace(TINY.preprocessing, touch_px=40))
    for count, (items, towers, config) in enumerate(
        [(grasps, build_matcher(TINY), TINY), (grasps, matcher, smaller)], 2
    ):
        encode_recording(items, towers, config, tmp_path, quiet=True)
        assert counted["photo_features"] == 9 * count


def test_a_photo_file_shared_by_grasps_is_encoded_once(grasps, matcher, counted):
    shared = [dataclasses.replace(grasp, photo=grasps[0].photo) for grasp in grasps[:3]]
    features = encode_recording(shared, matcher, TINY, None, quiet=True)
    assert counted["photo_features"] == 1
    assert features.photo.shape[0] == 3
    np.testing.assert_array_equal(features.photo[0], features.photo[2])


def test_a_touch_variant_changes_only_the_touch(grasps, matcher, tmp_path, counted):
    made = {
        touch_variant: encode_recording(grasps, matcher, TINY, tmp_path, touch_variant=touch_variant, quiet=True)
        for touch_variant in ("touch", "low_pass", "no_contact")
    }
    assert counted == {"touch_features": 27, "photo_features": 9}
    again = encode_recording(
        grasps[:5], matcher, TINY, None, touch_variant="no_contact", photo_features_from=made["touch"], quiet=True
    )
    np.testing.assert_array_equal(again.photo, made["touch"].photo[:5])
    for touch_variant in ("low_pass", "no_contact"):
        np.testing.assert_array_equal(made[touch_variant].photo, made["touch"].photo)
        assert np.abs(made[touch_variant].touch - made["touch"].touch).max() > 0.01
    frames = [dataclasses.replace(grasp, touches=grasp.backgrounds) for grasp in grasps]
    expected = encode_recording(frames, matcher, TINY, None, quiet=True)
    np.testing.assert_array_equal(made["no_contact"].touch, expected.touch)


def test_no_contact_frames_are_required_by_their_variant(grasps, matcher):
    lacking = [dataclasses.replace(grasp, backgrounds=()) for grasp in grasps]
    with pytest.raises(DatasetError, match="needs a no-contact frame"):
        encode_recording(lacking, matcher, TINY, None, touch_variant="no_contact", quiet=True)


def test_low_pass_keeps_colour_and_size_and_removes_fine_detail():
    image = np.full((60, 80, 3), 0.25, dtype=np.float32)
    image[::2] += 0.5  # stripes a pixel wide, mean 0.5
    plain = low_pass(image)
    assert plain.shape == image.shape
    np.testing.assert_allclose(plain, 0.5, atol=0.02)
    edge = np.zeros((60, 80, 3), dtype=np.float32)
    edge[:, 40:] = 1  # coarse structure remains
    assert low_pass(edge)[:, :10].max() < 0.1
    assert low_pass(edge)[:, -10:].min() > 0.9


@pytest.mark.parametrize("size", [(240, 320), (32, 48), (7, 9), (1, 3)])
def test_low_pass_equals_a_gaussian_blur_reduced_and_enlarged_again(size):
    image = np.random.default_rng(0).random((*size, 3), dtype=np.float32)
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), size[1] / 10), dtype=np.float32)
    np.testing.assert_allclose(low_pass(image), resize(resize(smooth, (6, 8)), size), atol=2e-6)  # float32 sums


def test_the_margin_of_a_photo_remains_and_the_inside_is_removed():
    image = np.zeros((80, 160, 3), dtype=np.float32)
    image[:10], image[-10:], image[:, :20], image[:, -20:] = 1, 1, 1, 1
    image[40, 80] = 0.5
    assert (photo_margin(image) == 1).all()
    noise = np.random.default_rng(1).random((80, 160, 3), dtype=np.float32)
    found = photo_margin(noise)
    np.testing.assert_array_equal(found[:10], noise[:10])
    assert len(np.unique(found[10:-10, 20:-20].reshape(-1, 3), axis=0)) == 1
    assert photo_margin(noise[:1, :1]).shape == (1, 1, 3)


def test_the_margin_variant_is_cached_separately_from_whole_photos(grasps, matcher, tmp_path):
    whole, framed = (
        encode_recording(grasps, matcher, TINY, tmp_path, photo_variant=photo_variant, quiet=True)
        for photo_variant in PHOTO_VARIANTS
    )
    np.testing.assert_array_equal(whole.touch, framed.touch)
    assert np.abs(whole.photo - framed.photo).max() > 0.01


def some_features():
    touch = np.arange(24, dtype=np.float32).reshape(4, 2, 3)
    return Features(("a", "b", "c", "d"), ("mug", "can", "mug", "box"), touch, touch[:, 0] + 100)


@pytest.mark.parametrize("part", ["touch", "photo"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_feature_that_is_not_finite_is_an_error_that_names_its_grasp(part, value):
    features = some_features()
    invalid = {"touch": features.touch.copy(), "photo": features.photo.copy()}
    invalid[part][1, ..., 0] = value
    with pytest.raises(NumericalError, match=f"{part} features must be finite; grasp {features.grasp_ids[1]} has"):
        Features(features.grasp_ids, features.object_ids, **invalid)


def test_features_are_returned_by_grasp_and_by_photo_file(grasps, matcher):
    features = encode_recording(grasps, matcher, TINY, None, quiet=True)
    known = features_by_image(grasps[2:4], features, torch.device("cpu"))
    assert set(known) == {grasp.grasp_id for grasp in grasps[2:4]} | {grasp.photo for grasp in grasps[2:4]}
    np.testing.assert_array_equal(known[grasps[3].grasp_id], features.touch[3].ravel())
    np.testing.assert_array_equal(known[grasps[2].photo], features.photo[2])
