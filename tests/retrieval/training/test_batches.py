"""Batches of pairs over distinct images: shared images give the same gradients."""

import dataclasses

import numpy as np
import pytest
import torch

from retrieval.data.dataset import load_grasps
from retrieval.data.pairs import PairSampler
from retrieval.errors import BadInput
from retrieval.model.fusion import Matcher
from retrieval.model.losses.loss import match_loss
from retrieval.training.batches import TrainedFeatures
from retrieval.training.train import WeightedLosses, batch_loss, set_training_mode
from tests.conftest import TINY
from tests.retrieval.training.test_train import load, same_weights, stop_after, trainer_for, with_training

# The paper's loss and numbers, on small pictures.
PAPER = dataclasses.replace(
    TINY,
    matcher=dataclasses.replace(TINY.matcher, dropout=0.0),
    training=dataclasses.replace(TINY.training, weights={}, freeze_batch_norm=True),
)


@pytest.fixture
def loaded(recording):
    """A loaded batch of three touches, each with two matching and two other photos, with shared photos."""
    sampler = PairSampler(load_grasps(recording), seed=0, positives=2, negatives=2, share_photos=True)
    return load(TrainedFeatures(PAPER, torch.device("cpu")), sampler.batch(0, 3))


def new_matcher():
    """Return a matcher in training mode, with fixed running statistics in batch normalisation."""
    torch.manual_seed(0)
    matcher = Matcher(dataclasses.replace(PAPER.matcher, standardise=False))
    set_training_mode(matcher, PAPER.training)
    return matcher


def gradients(matcher, backward):
    matcher.zero_grad()
    backward()
    return {name: part.grad.clone() for name, part in matcher.named_parameters() if part.grad is not None}


def difference(one, other):
    """Return the largest difference of two gradients, relative to each tensor's largest entry."""
    return max(float((one[name] - other[name]).abs().max() / one[name].abs().max().clamp(min=1e-12)) for name in one)


def shared_images(matcher, loaded):
    """Compute gradients like a training step: each distinct image passes through its tower once."""
    touch, photo = matcher.touch_features(loaded.touches), matcher.photo_features(loaded.photos)
    batch_loss(matcher, WeightedLosses(PAPER.training.weights, matcher, 9), loaded.batch, touch, photo).backward()


def pair_by_pair(matcher, loaded):
    """Sum the gradients of one touch and one photo at a time."""
    batch = loaded.batch
    for touch, photo, label in zip(batch.touch_index, batch.photo_index, batch.labels, strict=True):
        logit = matcher(loaded.touches[touch][None], loaded.photos[photo][None])
        (match_loss(logit, torch.tensor([label])) / len(batch.labels)).backward()


def test_shared_images_give_the_gradients_of_one_pair_at_a_time(loaded):
    """Running statistics are fixed, since batch statistics would make a photo's features depend on its batch."""
    matcher = new_matcher()
    one, other = (gradients(matcher, lambda way=way: way(matcher, loaded)) for way in (shared_images, pair_by_pair))
    assert one.keys() == other.keys()
    assert difference(one, other) < 1e-5  # float32 sums of 8 and 48 parts in another order
    assert max(float(grad.abs().max()) for grad in one.values()) > 1e-4


def test_every_distinct_image_is_loaded_once_for_a_batch(recording):
    batch = PairSampler(load_grasps(recording), seed=0, share_photos=True).batch(0, 6)
    loaded = load(TrainedFeatures(PAPER, torch.device("cpu")), batch)
    assert len(loaded.photos) == len(batch.photos) < len(np.unique(batch.photo_index)) + 1 <= 25
    assert len(loaded.touches) == 6


@pytest.mark.parametrize("augment", [False, True])
def test_any_number_of_workers_gives_the_same_checkpoint(augment, recording, tmp_path):
    for workers in (0, 2):
        config = with_training(TINY, workers=workers, augment=augment)
        trainer_for(recording, tmp_path / f"{workers}.safetensors", config).run(quiet=True)
    assert (tmp_path / "0.safetensors").read_bytes() == (tmp_path / "2.safetensors").read_bytes()


def test_a_training_resumes_with_another_number_of_workers(recording, tmp_path):
    whole, first, other = (
        trainer_for(recording, tmp_path / f"{name}.safetensors", with_training(TINY, workers=workers))
        for name, workers in (("whole", 0), ("m", 0), ("m", 2))
    )
    whole.run(quiet=True)
    with pytest.raises(RuntimeError, match="power cut"):
        stop_after(first, 3)
    other.run(quiet=True)
    assert same_weights(whole.matcher.state_dict(), other.matcher.state_dict())


def test_an_error_in_a_worker_is_the_plain_error(recording):
    source = TrainedFeatures(with_training(TINY, workers=1), torch.device("cpu"))
    batch = PairSampler(load_grasps(recording), seed=0).batch(0, 2)
    missing = dataclasses.replace(batch.grasps[0], touches=(recording / "gone.png",) * 2)
    with pytest.raises(BadInput) as failed:
        load(source, dataclasses.replace(batch, grasps=[missing, *batch.grasps[1:]]))
    assert "gone.png" in str(failed.value)
    assert "Traceback" not in str(failed.value)
