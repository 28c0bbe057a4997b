"""Batches of pairs over distinct images: what sharing them leaves as it was."""

import dataclasses
import threading

import numpy as np
import pytest
import torch

from retrieval.data.dataset import PairSampler, load_grasps
from retrieval.model.fusion import Matcher
from retrieval.model.losses.match import match_loss
from retrieval.training.batches import TrainedFeatures
from retrieval.training.step import WeightedLosses, batch_loss
from retrieval.training.train import set_training_mode
from tests.conftest import TINY

# The paper's loss and numbers, on small pictures.
PAPER = dataclasses.replace(
    TINY,
    matcher=dataclasses.replace(TINY.matcher, dropout=0.0),
    training=dataclasses.replace(TINY.training, weights={}, freeze_batch_norm=True),
)


@pytest.fixture
def loaded(recording):
    """Three touches with two photos of their objects and two of others', the photos shared, and their images."""
    sampler = PairSampler(load_grasps(recording), seed=0, positives=2, negatives=2, share_photos=True)
    with TrainedFeatures(PAPER, torch.device("cpu")) as source:
        return source.prepare(None, sampler.batch(0, 3)).result()


def new_matcher():
    """In training mode but for the batch normalisation, which keeps to its running statistics."""
    torch.manual_seed(0)
    matcher = Matcher(dataclasses.replace(PAPER.matcher, standardise=False))
    set_training_mode(matcher, PAPER.training)
    return matcher


def gradients(matcher, backward):
    matcher.zero_grad()
    backward()
    return {name: part.grad.clone() for name, part in matcher.named_parameters() if part.grad is not None}


def difference(one, other):
    """Largest difference of two gradients, as a share of each tensor's largest entry."""
    return max(float((one[name] - other[name]).abs().max() / one[name].abs().max().clamp(min=1e-12)) for name in one)


def shared_images(matcher, loaded):
    """What a training step does: each distinct image through its tower once."""
    touch, photo = matcher.touch_features(loaded.touches), matcher.photo_features(loaded.photos)
    batch_loss(matcher, WeightedLosses(PAPER.training.weights, matcher, 9), loaded.batch, touch, photo)[0].backward()


def pair_by_pair(matcher, loaded):
    """The plain way: one touch and one photo at a time, the gradients added up."""
    batch = loaded.batch
    for touch, photo, label in zip(batch.touch_index, batch.photo_index, batch.labels, strict=True):
        logit = matcher(loaded.touches[touch][None], loaded.photos[photo][None])
        (match_loss(logit, torch.tensor([label])) / len(batch.labels)).backward()


def test_shared_images_give_the_gradients_of_one_pair_at_a_time(loaded):
    """With running statistics: in training batch normalisation makes a photo's features depend on its batch."""
    matcher = new_matcher()
    one, other = (gradients(matcher, lambda way=way: way(matcher, loaded)) for way in (shared_images, pair_by_pair))
    assert one.keys() == other.keys()
    assert difference(one, other) < 1e-5  # float32 sums of 8 and 48 parts in another order
    assert max(float(grad.abs().max()) for grad in one.values()) > 1e-4


def test_a_batch_is_loaded_on_another_thread_while_its_caller_goes_on(recording):
    """A step that loaded its own images would wait for each of them."""
    batch = PairSampler(load_grasps(recording), seed=0).batch(0, 2)
    go_on, threads = threading.Event(), set()
    with TrainedFeatures(PAPER, torch.device("cpu")) as source:
        load = source._photo

        def waiting(path):
            threads.add(threading.current_thread())
            assert go_on.wait(10)
            return load(path)

        source._photo = waiting
        upcoming = source.prepare(None, batch)
        assert not upcoming.done()
        go_on.set()
        assert len(upcoming.result().photos) == len(batch.photos)
    assert threading.main_thread() not in threads


def test_every_distinct_image_is_loaded_once_for_a_batch(recording):
    batch = PairSampler(load_grasps(recording), seed=0, share_photos=True).batch(0, 6)
    with TrainedFeatures(PAPER, torch.device("cpu")) as source:
        loaded = source.prepare(None, batch).result()
    assert len(loaded.photos) == len(batch.photos) < len(np.unique(batch.photo_index)) + 1 <= 25
    assert len(loaded.touches) == 6
