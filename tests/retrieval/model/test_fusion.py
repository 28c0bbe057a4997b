"""The fusion head and its partial activations, and scoring many photos at once."""

import math

import torch
from torch.nn import functional

from retrieval.model import fusion_scorer
from retrieval.model.config import MatcherConfig
from retrieval.model.fusion import FusionHead, Matcher, Standardise


def concatenated_forward(matcher, touches, photos):
    """The paper's network as published: one first layer over the concatenated features of all images."""
    fingers = [matcher.touch_tower(touches[:, finger]) for finger in range(touches.shape[1])]
    features = torch.cat([*fingers, matcher.photo_tower(photos)], dim=1)
    head = matcher.head
    weight = torch.cat([head.touch_partial.weight, head.photo_partial.weight], dim=1)
    hidden = functional.relu(functional.linear(features, weight, head.touch_partial.bias))
    hidden = functional.relu(head.second(head.dropout(hidden)))
    return head.out(hidden)[:, 0]


def test_the_logit_from_partial_activations_equals_the_concatenated_forward():
    torch.manual_seed(0)
    matcher = Matcher(MatcherConfig(tower="small", tower_output="classes", hidden=64)).eval()
    touches, photos = torch.rand(3, 2, 3, 32, 32), torch.rand(3, 3, 32, 32)
    with torch.inference_mode():
        touch = matcher.touch_encoding(matcher.touch_features(touches))
        photo = matcher.photo_encoding(matcher.photo_features(photos))
        ours, naive = matcher.head(touch.partial, photo.partial), concatenated_forward(matcher, touches, photos)
    # 1e-5 relative to the size of the terms of the last layer, float32.
    torch.testing.assert_close(ours, naive, rtol=1e-5, atol=1e-5 * float(naive.abs().max()))
    torch.testing.assert_close(matcher(touches, photos), ours, rtol=1e-4, atol=1e-4 * float(naive.abs().max()))


def test_the_cosine_of_the_embeddings_adds_to_the_logit_and_is_part_of_the_partial_activations(monkeypatch):
    monkeypatch.setattr(fusion_scorer, "BLOCK", 2)
    torch.manual_seed(0)
    config = MatcherConfig(tower="small", tower_output="pooled", hidden=64, embedding_dim=16, cosine=True)
    matcher = Matcher(config).eval()
    touches, photos = torch.rand(3, 2, 3, 32, 32), torch.rand(3, 3, 32, 32)
    with torch.inference_mode():
        touch = matcher.touch_encoding(matcher.touch_features(touches))
        photo = matcher.photo_encoding(matcher.photo_features(photos))
        without, cosine = concatenated_forward(matcher, touches, photos), (touch.embedding * photo.embedding).sum(1)
        expected = without + matcher.cosine_scale * cosine
        assert touch.partial.shape == photo.partial.shape == (3, config.partial_width) == (3, 64 + 16)
        torch.testing.assert_close(matcher(touches, photos), expected, rtol=1e-5, atol=1e-5)
        two = matcher.head.scorer.logits(touch.partial[:2].numpy(), photo.partial.numpy())
        by_pair = matcher.head(touch.partial[:2, None], photo.partial[None]).sum(0)
        torch.testing.assert_close(torch.from_numpy(two), by_pair, rtol=1e-5, atol=1e-5)
        matcher.cosine_scale.fill_(-1.0)  # the scale never rewards a low cosine
        touch, photo = matcher.touch_encoding(torch.rand(3, 512)), matcher.photo_encoding(torch.rand(3, 256))
        assert not touch.partial[:, 64:].any()


def test_a_feature_that_hardly_varies_is_not_scaled_up_while_plain_scaling_amplifies_its_rounding():
    torch.manual_seed(0)
    features = torch.stack([torch.randn(400), 100 + 0.01 * torch.randn(400)], dim=1)
    ours, plain = Standardise(2), torch.nn.BatchNorm1d(2, affine=False)
    for norm in (ours, plain):
        for _ in range(200):
            norm(features)
        norm.eval()
    rounded = features + torch.tensor([0.0, 0.1])  # a thousandth of the mean, like float16 weights
    moved = {norm: float((norm(rounded) - norm(features)).abs().max()) for norm in (ours, plain)}
    assert moved[ours] < 0.06
    assert moved[plain] > 5
    torch.testing.assert_close(ours(features)[:, 0], plain(features)[:, 0], rtol=0, atol=1e-6)


def test_the_paper_configuration_has_the_papers_layers():
    with torch.device("meta"):
        matcher = Matcher(MatcherConfig())
    assert matcher.head.touch_partial.weight.shape == (1024, 2000)
    assert matcher.head.photo_partial.weight.shape == (1024, 1000)
    assert matcher.head.photo_partial.bias is None
    assert matcher.head.second.weight.shape == (1024, 1024)
    assert matcher.head.out.weight.shape == (1, 1024)
    assert sum(value.numel() for value in matcher.touch_tower.parameters()) == 25_557_032


def test_the_partial_activation_layers_start_like_one_layer_over_the_concatenation():
    torch.manual_seed(0)
    head = FusionHead(2000, 1000, MatcherConfig())
    bound = 1 / math.sqrt(3000)
    for weight in (head.touch_partial.weight, head.photo_partial.weight):
        assert bound * 0.99 < float(weight.detach().abs().max()) <= bound
