"""The learned pooling of a set of grasps: order and padding do not matter, and one grasp is not changed."""

import numpy as np
import pytest
import torch

from retrieval.methods import set_fusion
from retrieval.methods.selection import next_rows_of_object
from retrieval.methods.set_fusion import SetHead
from retrieval.model.fusion import FusionHead


def random_head(hidden=16, seed=0):
    """Return a head whose pooling differs from its initial state, the mean."""
    torch.manual_seed(seed)
    head = SetHead(10, 7, hidden, 0.5).eval()
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.normal_(0, 0.3)
    return head.requires_grad_(False)


def pooled(head, partials):
    return head.pool(partials[None], torch.ones(1, len(partials), dtype=torch.bool))[0]


def test_pooling_equals_the_formula():
    head, partials = random_head(), torch.randn(3, 16, generator=torch.Generator().manual_seed(1))
    scores = [float((head.attention.weight[0] * h.relu()).sum() + head.attention.bias) for h in partials]
    weights = [np.exp(score) / sum(np.exp(scores)) for score in scores]
    attended = sum(weight * h for weight, h in zip(weights, partials, strict=True))
    mean = (partials[0] + partials[1] + partials[2]) / 3
    largest = torch.maximum(torch.maximum(partials[0], partials[1]), partials[2])
    expected = mean + head.attended.weight @ (attended - mean) + head.largest.weight @ (largest - mean)
    expected = expected + np.log(3) * head.size
    torch.testing.assert_close(pooled(head, partials), expected, rtol=1e-5, atol=1e-5)


def test_the_order_of_grasps_does_not_matter():
    head, partials = random_head(), torch.randn(6, 16, generator=torch.Generator().manual_seed(2))
    for seed in range(5):
        order = torch.randperm(6, generator=torch.Generator().manual_seed(seed))
        torch.testing.assert_close(pooled(head, partials[order]), pooled(head, partials), rtol=1e-5, atol=1e-5)


def test_a_set_of_one_is_scored_like_a_touch_in_late_fusion():
    head = random_head()
    plain = FusionHead(10, 7, 16, 0.5).eval()
    plain.load_state_dict(head.state_dict(), strict=False)
    generator = torch.Generator().manual_seed(3)
    touch, photo = head.touch_partial(torch.randn(4, 10, generator=generator)), head.photo_partial(torch.randn(4, 7))
    one = head.pool(touch[:, None], torch.ones(4, 1, dtype=torch.bool))
    torch.testing.assert_close(head(one, photo), plain(touch, photo))


def test_an_untrained_pooling_is_the_mean():
    head, partials = SetHead(10, 7, 16, 0.5), torch.randn(5, 16)
    torch.testing.assert_close(pooled(head, partials), partials.mean(0))


@pytest.mark.parametrize("padding", [0.0, 1e6, -1e6, float("nan")])
def test_the_values_of_padding_do_not_matter(padding):
    head, generator = random_head(), torch.Generator().manual_seed(4)
    sets = [torch.randn(size, 16, generator=generator) for size in (1, 8, 3)]
    batch, counted = torch.full((3, 8, 16), padding), torch.zeros(3, 8, dtype=torch.bool)
    for place, partials in enumerate(sets):
        batch[place, : len(partials)], counted[place, : len(partials)] = partials, True
    single = torch.stack([pooled(head, partials) for partials in sets])
    torch.testing.assert_close(head.pool(batch, counted), single, rtol=1e-5, atol=1e-5)


def test_padding_gets_no_gradient():
    head, counted = random_head(), torch.tensor([[True, True, False]])
    partials = torch.randn(1, 3, 16, generator=torch.Generator().manual_seed(5), requires_grad=True)
    (gradient,) = torch.autograd.grad(head.pool(partials, counted).sum(), partials)
    assert torch.isfinite(gradient).all()
    assert not gradient[0, 2].any()
    assert gradient[0, :2].abs().min() > 0


def test_scores_in_blocks_equal_the_scores_of_single_pairs(monkeypatch):
    head = random_head()
    fusion = object.__new__(set_fusion.SetFusion)
    fusion._head = head
    touch, photo = torch.randn(5, 16), torch.randn(9, 16)
    with torch.inference_mode():
        expected = [[head(t[None], p[None]).item() for p in photo] for t in touch]
    for block in (1, 4, 20, 10_000):
        monkeypatch.setattr(set_fusion, "PAIRS_PER_BLOCK", block)
        np.testing.assert_allclose(fusion._logits(touch, photo), expected, rtol=1e-5, atol=1e-5)


def test_next_rows_are_of_the_same_object_cyclically():
    assert next_rows_of_object(np.array([0, 1, 0, 0, 1]), 2).tolist() == [[0, 2], [1, 4], [2, 3], [3, 0], [4, 1]]
    assert next_rows_of_object(np.array([0, 1, 1]), 3).tolist() == [[0, 0, 0], [1, 2, 1], [2, 1, 2]]
