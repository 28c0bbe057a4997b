"""The towers in the form of queries and builds, compared with their form in training."""

import copy
from functools import cache

import numpy as np
import pytest
import torch
from torch import nn

from retrieval.errors import NumericalError
from retrieval.model.config import MatcherConfig
from retrieval.model.encode import encode_photos, for_inference, photo_features, to_batch
from retrieval.model.fusion import Matcher

SIDE = 32


@cache
def matcher_with_statistics(tower):
    """Return a matcher in evaluation mode whose batch normalisations have statistics, scale and shift."""
    torch.manual_seed(0)
    matcher = Matcher(MatcherConfig(tower=tower, tower_output="stages", hidden=16, standardise=True, candidate_width=8))
    for module in matcher.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.uniform_(module.bias, -0.5, 0.5)
            module.momentum = None
    with torch.no_grad():
        matcher.train()(torch.rand(4, 2, 3, SIDE, SIDE), torch.rand(4, 3, SIDE, SIDE))
    return matcher.eval()


def images(count, seed=1):
    return list(np.random.default_rng(seed).random((count, SIDE, SIDE, 3), dtype=np.float32))


@pytest.mark.parametrize("tower", ["mobilenet_v2", "resnet18"])
@torch.inference_mode()
def test_folded_towers_are_as_close_to_float64_as_the_plain_ones(tower):
    """These weights are random, and 50 layers of them amplify any rounding, in both forms."""
    matcher, photos = matcher_with_statistics(tower), images(2)
    plain, ours = matcher.photo_features(to_batch(photos)), photo_features(matcher, photos)
    double = copy.deepcopy(matcher.photo_tower).double()
    exact = double._encode((to_batch(photos).double() - double.mean) / double.std)
    rounding, error = (float((features - exact).abs().max() / exact.abs().max()) for features in (plain, ours))
    assert error <= 3 * rounding + 1e-6
    assert error <= 1e-3


def test_encoding_leaves_the_matcher_unchanged():
    matcher = matcher_with_statistics("resnet18")
    before = copy.deepcopy(matcher.state_dict())
    encode_photos(matcher, images(2))
    after = matcher.state_dict()
    assert list(after) == list(before)
    for name, tensor in before.items():
        assert torch.equal(after[name], tensor)
        assert after[name].stride() == tensor.stride()


def test_a_tower_in_training_mode_is_not_folded_because_its_normalisation_depends_on_the_batch():
    matcher = copy.deepcopy(matcher_with_statistics("resnet18")).train()
    fast = for_inference(matcher, "photo_tower")
    assert fast.photo_tower is matcher.photo_tower
    batch = to_batch(images(4))
    with torch.inference_mode():
        together, alone = matcher.photo_features(batch)[:1], matcher.eval().photo_features(batch[:1])
    assert not torch.allclose(together, alone, rtol=0.01)  # folding would give `alone`


@pytest.mark.parametrize("tower", ["resnet18", "small"])
def test_the_encoding_does_not_depend_on_the_batch(tower):
    matcher, photos, rows = matcher_with_statistics(tower), images(19), [0, 15, 18]  # of two batches
    alone = [encode_photos(matcher, [photos[row]]) for row in rows]
    for batches, each in zip(encode_photos(matcher, photos), zip(*alone, strict=True), strict=True):
        together = batches[rows]
        # Another batch size may sum in another order: float32 rounding of the largest outputs.
        torch.testing.assert_close(together, torch.cat(each), rtol=0, atol=1e-4 * float(together.abs().max()))


def test_a_pixel_that_is_not_finite_is_refused_by_a_folded_tower_too():
    photo = images(1)[0]
    photo[3, 4, 1] = np.nan
    with pytest.raises(NumericalError, match="finite pixels"):
        encode_photos(matcher_with_statistics("resnet18"), [photo])
