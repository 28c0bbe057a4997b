"""The two projections: best step, logits from cosines, and the draws of batches."""

import numpy as np
import pytest
import torch

from retrieval.methods.contrastive import ContrastiveEmbedding, Projections, row_sampler
from retrieval.methods.method import MethodSettings
from retrieval.model.config import Config, MatcherConfig, TrainingConfig
from retrieval.model.fusion import LOG_SCALE_MAX
from retrieval.model.losses.listwise import contrastive_loss
from tests.retrieval.methods.test_methods import planted

CONFIG = Config(matcher=MatcherConfig(embedding_dim=4), training=TrainingConfig(iterations=40))


TRAIN, VALIDATION, TEST = (planted(objects, seed, widths=(6, 5)) for seed, objects in enumerate((10, 4, 5)))


def test_scores_are_scaled_cosines():
    fitted = ContrastiveEmbedding(MethodSettings(CONFIG))
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    fitted.fit(TRAIN, VALIDATION)
    assert torch.equal(torch.rand(4), expected)  # a fit does not change the global random stream
    touch, photo = fitted.encode_touch(TEST.touch), fitted.encode_photo(TEST.photo)
    np.testing.assert_allclose(np.linalg.norm(touch, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(photo, axis=1), 1, atol=1e-6)
    scores, scale = fitted.score(touch, photo), fitted.best_params["scale"]
    np.testing.assert_allclose(scores, scale * touch @ photo.T, atol=1e-4)
    assert 1 <= scale <= 100


def test_the_scale_is_clamped_at_a_hundred_and_has_a_gradient_there():
    projections = Projections(3, 3, 2, 0.0)
    with torch.no_grad():
        projections.log_scale.fill_(7.0)
    projections.clamp_scale()
    assert projections.log_scale.item() == pytest.approx(LOG_SCALE_MAX)
    touch, photo, objects = torch.eye(2), torch.eye(2).flip(0), torch.arange(2)
    (gradient,) = torch.autograd.grad(
        contrastive_loss(touch, photo, objects, objects, projections.log_scale), projections.log_scale
    )
    assert gradient.item() > 1  # a clamp of the forward value would have none


def test_rows_are_drawn_uniformly_from_the_requested_objects():
    owner, objects = torch.tensor([0, 1, 0, 2, 1, 1]), torch.tensor([0, 1, 2]).repeat(3000)
    drawn = row_sampler(owner, torch.Generator().manual_seed(0))(objects)
    assert torch.equal(owner[drawn], objects)
    # Four standard deviations of 3,000 draws at 1/2 and at 1/3.
    expected = torch.tensor([1500, 1000, 1500, 3000, 1000, 1000])
    assert ((torch.bincount(drawn, minlength=6) - expected).abs() < 104).all()
