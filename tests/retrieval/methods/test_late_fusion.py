"""Late fusion among the methods is the model of `retrieve train` and `retrieve query`, on features of images."""

import dataclasses

import numpy as np
import pytest
import torch

from retrieval.data.dataset import load_grasps, make_split
from retrieval.methods.late_fusion import LateFusion
from retrieval.methods.method import MethodSettings
from retrieval.methods.retrieve_rerank import RetrieveRerank, merge_scores
from retrieval.model.checkpoint import load_checkpoint
from retrieval.training.features import encode_recording
from retrieval.training.initial_weights import build_matcher
from retrieval.training.trainer import Trainer, train_matcher
from tests.conftest import TINY

FROZEN = dataclasses.replace(TINY, training=dataclasses.replace(TINY.training, freeze_towers=True))


def with_training(config, **changes):
    return dataclasses.replace(config, training=dataclasses.replace(config.training, **changes))


@pytest.fixture(scope="module")
def split(recording):
    return make_split(load_grasps(recording), validation=0.25, test=0.2, seed=0)


@pytest.fixture(scope="module")
def features(recording):
    torch.manual_seed(FROZEN.training.seed)
    return encode_recording(load_grasps(recording), build_matcher(FROZEN), FROZEN, None)


@pytest.fixture(scope="module")
def parts(features, split):
    return tuple(features.of_objects(part) for part in (split.train, split.validation, split.test))


@pytest.fixture(scope="module")
def fitted(parts, tmp_path_factory):
    return fit(LateFusion, parts, tmp_path_factory.mktemp("fits"))


def fit(method, parts, folder, config=FROZEN, start=None):
    fitted_method = method(MethodSettings(config, folder=folder, start=start))
    fitted_method.fit(*parts[:2])
    return fitted_method


def encodings(method, part):
    return method.encode_touch(part.touch), method.encode_photo(part.photo)


def test_scores_are_the_match_logits_of_every_pair(fitted, parts):
    matcher, part = load_checkpoint(fitted.settings.folder / "late_fusion-0.safetensors").matcher, parts[2]
    with torch.inference_mode():
        touches = matcher.touch_encoding(torch.from_numpy(part.touch).flatten(1)).partial
        photos = matcher.photo_encoding(torch.from_numpy(part.photo)).partial
        expected = [[matcher.head(touch[None], photo[None]).item() for photo in photos] for touch in touches]
    np.testing.assert_allclose(fitted.score(*encodings(fitted, part)), expected, rtol=1e-4, atol=1e-5)


def test_the_method_trains_the_same_model_as_the_command_line(recording, split, fitted, tmp_path):
    ours = load_checkpoint(fitted.settings.folder / "late_fusion-0.safetensors")
    theirs = train_matcher(recording, tmp_path / "m.safetensors", FROZEN, split=split)
    assert (ours.provenance["step"], ours.config) == (theirs.provenance["step"], theirs.config)
    for name, weight in theirs.matcher.state_dict().items():
        # The same steps, on features from batches of another size.
        torch.testing.assert_close(ours.matcher.state_dict()[name], weight, rtol=1e-3, atol=2e-4)


def test_another_setting_or_other_features_are_trained_again(parts, tmp_path, monkeypatch):
    monkeypatch.setattr("retrieval.training.features.touch_features", lambda *_: pytest.fail("read an image"))
    first = fit(LateFusion, parts, tmp_path)
    slower = with_training(FROZEN, learning_rate=1e-4)
    assert fit(LateFusion, parts, tmp_path, slower).best_params != first.best_params
    assert fit(LateFusion, parts, tmp_path).best_params == first.best_params
    moved = dataclasses.replace(parts[0], touch=parts[0].touch + 1)
    assert fit(LateFusion, (moved, *parts[1:]), tmp_path).best_params != first.best_params


@pytest.mark.parametrize("method", [LateFusion, RetrieveRerank])
def test_a_finished_fit_or_a_checkpoint_is_not_trained_again_and_scores_the_same(method, fitted, parts, monkeypatch):
    monkeypatch.setattr(Trainer, "run", lambda *_, **__: pytest.fail("trained"))
    checkpoint = load_checkpoint(fitted.settings.folder / "late_fusion-0.safetensors")
    loaded = method(MethodSettings(FROZEN, model=checkpoint))
    loaded.fit(*parts[:2])
    again = fit(method, parts, fitted.settings.folder)
    assert again.best_params["step"] == fitted.best_params["step"]
    scores = [each.score(*encodings(each, parts[2])) for each in (loaded, again)]
    np.testing.assert_array_equal(*scores)
    if method is LateFusion:
        np.testing.assert_array_equal(scores[0], fitted.score(*encodings(fitted, parts[2])))


def expected_order(logits, nearness, count):
    """Return the photos nearest to all grasps of the set by their summed logit, then the others by nearness."""
    mean = nearness.mean(0)
    nearest = sorted(range(len(mean)), key=lambda column: (-mean[column], column))
    return sorted(nearest[:count], key=lambda column: -logits[column]) + nearest[count:]


@pytest.mark.parametrize("grasps", [1, 2, 3])
def test_reranking_orders_candidates_by_logit_and_the_rest_after_them_by_embedding(grasps, fitted, parts):
    every = parts[0].concatenate(parts[2])
    method = fit(RetrieveRerank, parts, fitted.settings.folder)
    matcher = load_checkpoint(fitted.settings.folder / "late_fusion-0.safetensors").matcher
    with torch.inference_mode():
        touch = matcher.touch_encoding(torch.from_numpy(every.touch).flatten(1)).embedding
        nearness = (touch @ matcher.photo_encoding(torch.from_numpy(every.photo)).embedding.T).numpy()
    logits = fitted.score(*encodings(fitted, every))
    sets = np.arange(4 * grasps).reshape(4, grasps)
    scores = method.score_sets(*encodings(method, every), sets)
    count = round(0.25 * len(every))
    for row, members in enumerate(sets):
        ranked = np.argsort(-scores[row], kind="stable").tolist()
        assert ranked == expected_order(logits[members].sum(0, dtype=np.float64), nearness[members], count)
    if grasps == 1:
        np.testing.assert_allclose(method.score(*encodings(method, every))[:4], scores, rtol=1e-4, atol=1e-5)


def test_photos_that_are_not_reranked_follow_below_the_smallest_logit_in_the_order_of_their_cosines():
    nearness, logits = np.array([[1.0, 0.5, 0.0, -1.0]], np.float32), np.array([5.0, -7.0], np.float32)
    assert merge_scores(nearness, np.array([2, 3]), logits).tolist() == [-8.0, -8.5, 5.0, -7.0]


def test_a_model_without_trained_embeddings_scores_every_photo(parts, tmp_path):
    method = fit(RetrieveRerank, parts, tmp_path, with_training(FROZEN, weights={}))
    assert method.best_params["reranked_fraction"] == 1.0
    late = fit(LateFusion, parts, tmp_path, with_training(FROZEN, weights={}))
    np.testing.assert_array_equal(method.score(*encodings(method, parts[2])), late.score(*encodings(late, parts[2])))


def test_a_fit_from_a_checkpoint_is_not_worse_on_validation_objects_and_takes_its_candidate_encoder(parts, tmp_path):
    config = dataclasses.replace(FROZEN, matcher=dataclasses.replace(FROZEN.matcher, candidate_width=8))
    first = fit(RetrieveRerank, parts, tmp_path / "a", config)
    further = with_training(config, learning_rate=1e-5, iterations=2)
    second = fit(RetrieveRerank, parts, tmp_path / "b", further, start=first.checkpoint)
    assert second.best_params["validation_auc"] >= first.best_params["validation_auc"]
    encoders = (each.checkpoint.matcher.candidate_encoder.state_dict() for each in (first, second))
    for ours, theirs in zip(*(encoder.values() for encoder in encoders), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_candidates_come_from_the_candidate_encoder_of_the_configuration(parts, tmp_path):
    config = dataclasses.replace(FROZEN, matcher=dataclasses.replace(FROZEN.matcher, candidate_width=8))
    own, plain = (fit(RetrieveRerank, parts, tmp_path / name, each) for name, each in (("a", config), ("b", FROZEN)))
    for side, width in enumerate((FROZEN.matcher.touch_partial_width, FROZEN.matcher.partial_width)):
        ours, others = encodings(own, parts[2])[side], encodings(plain, parts[2])[side]
        np.testing.assert_allclose(ours[:, :width], others[:, :width], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(ours[:, width:], axis=1), 1, rtol=1e-5)
        assert np.abs((ours[:, width:] * others[:, width:]).sum(1)).max() < 0.9  # other embeddings
