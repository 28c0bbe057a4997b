"""The two towers of projections: what is kept of training, and how logits are made of cosines."""

import numpy as np
import pytest
import torch

from retrieval.methods import contrastive as module
from retrieval.methods.contrastive import ContrastiveEmbedding, Projections, SigmoidEmbedding, SigmoidProjections
from retrieval.methods.method import MethodSettings
from retrieval.methods.object_sampler import ObjectSampler, seeded_generator
from retrieval.model.config import Config, MatcherConfig, TrainingConfig
from retrieval.model.losses.contrastive import LOG_SCALE_MAX
from retrieval.model.losses.sigmoid import SIGMOID_BIAS_INIT
from retrieval.training.features import Features

CONFIG = Config(matcher=MatcherConfig(embedding_dim=4), training=TrainingConfig(iterations=80))


def planted(objects, seed, each=6):
    """Touch and photo features that see two numbers of the object, and noise."""
    world, rng = np.random.default_rng(11), np.random.default_rng(seed)
    latent = np.repeat(rng.standard_normal((objects, 2)), each, axis=0)
    touch, photo = (
        latent @ world.standard_normal((2, d)) + 0.3 * rng.standard_normal((len(latent), d)) for d in (6, 5)
    )
    return Features(
        tuple(f"{seed}-{row}" for row in range(len(latent))),
        tuple(f"{seed}-{row // each}" for row in range(len(latent))),
        touch.reshape(-1, 1, 6).astype(np.float32),
        photo.astype(np.float32),
    )


TRAIN, VALIDATION, TEST = planted(10, 0), planted(4, 1), planted(5, 2)


@pytest.mark.parametrize("method", [ContrastiveEmbedding, SigmoidEmbedding])
def test_scores_are_scaled_cosines_with_the_learned_bias(method):
    fitted = method(MethodSettings(CONFIG))
    fitted.fit(TRAIN, VALIDATION)
    touch, photo = fitted.encode_touch(TEST.touch), fitted.encode_photo(TEST.photo)
    np.testing.assert_allclose(np.linalg.norm(touch, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(photo, axis=1), 1, atol=1e-6)
    scores, scale, bias = fitted.score(touch, photo), fitted.best_params["scale"], fitted.best_params["bias"]
    for i in range(len(touch)):
        for j in range(len(photo)):
            assert scores[i, j] == pytest.approx(scale * float(touch[i] @ photo[j]) + bias, abs=1e-4)
    assert (bias == 0) == (method is ContrastiveEmbedding)
    assert 1 <= scale <= 100


@pytest.mark.slow
def test_what_was_chosen_is_among_what_was_tried():
    fitted = ContrastiveEmbedding(MethodSettings(CONFIG))
    fitted.fit(TRAIN, VALIDATION)
    assert (fitted.best_params["dropout"], fitted.best_params["weight_decay"]) in module.REGULARISATIONS
    assert fitted.best_params["steps"] in (40, 80)
    assert fitted.best_params["validation_auc"] > 0.7


def test_the_sigmoid_loss_starts_from_its_own_scale_and_bias():
    assert Projections(3, 3, 2, 0.0).logit_map() == (pytest.approx(1 / 0.07, rel=1e-6), 0.0)
    assert SigmoidProjections(3, 3, 2, 0.0).logit_map() == (pytest.approx(10, rel=1e-6), SIGMOID_BIAS_INIT)


def test_the_scale_is_held_at_a_hundred_and_can_come_back():
    projections = Projections(3, 3, 2, 0.0)
    with torch.no_grad():
        projections.log_scale.fill_(7.0)
    projections.clamp_scale()
    assert projections.log_scale.item() == pytest.approx(LOG_SCALE_MAX)
    touch, photo, objects = torch.eye(2), torch.eye(2).flip(0), torch.arange(2)
    (gradient,) = torch.autograd.grad(projections.loss(touch, photo, objects, objects), projections.log_scale)
    assert gradient.item() > 1  # a clamp of the forward value would have none


def test_a_feature_vector_of_zeros_has_an_embedding_of_its_own_bias_and_no_nan():
    projections = Projections(3, 3, 2, 0.0)
    with torch.no_grad():
        projections.touch.bias.zero_()
    assert projections(torch.zeros(1, 3), projections.touch).tolist() == [[0.0, 0.0]]


def test_fitting_leaves_the_random_stream_of_others_alone():
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    ContrastiveEmbedding(MethodSettings(CONFIG)).fit(TRAIN, VALIDATION)
    assert torch.equal(torch.rand(4), expected)


def draws(owner, seed=0):
    return ObjectSampler(torch.tensor(owner), torch.Generator().manual_seed(seed))


def test_rows_are_drawn_of_the_asked_objects_and_each_row_alike():
    owner = [0, 1, 0, 2, 1, 1]
    drawn = draws(owner).rows(torch.tensor([0, 1, 2]).repeat(3000))
    assert all(owner[row] == place % 3 for place, row in enumerate(drawn.tolist()))
    counts = torch.bincount(drawn, minlength=6)
    # Four standard deviations of 3,000 draws at 1/2 and at 1/3.
    assert (counts[[0, 2]] - 1500).abs().max() < 110
    assert (counts[[1, 4, 5]] - 1000).abs().max() < 104
    assert counts[3] == 3000


def test_a_batch_holds_an_object_once_and_others_are_others():
    drawn = draws([0, 1, 2, 3])
    assert sorted(drawn.distinct_objects(10).tolist()) == [0, 1, 2, 3]
    assert len(set(drawn.distinct_objects(2).tolist())) == 2
    objects = torch.arange(4)
    others = drawn.other_objects(objects, 500)
    assert not (others == objects[:, None]).any()
    assert all(len(set(row)) == 3 for row in others.tolist())


def test_sets_hold_distinct_grasps_of_one_object_of_every_size_it_allows():
    owner = [0] * 12 + [1] * 3 + [2]
    objects = torch.tensor([0, 1, 2]).repeat(400)
    rows, held = draws(owner).sets(objects, 8)
    sizes = held.sum(1)
    for place in range(len(objects)):
        taken = rows[place][held[place]].tolist()
        assert len(set(taken)) == len(taken)
        assert all(owner[row] == objects[place] for row in taken)
    assert set(sizes[objects == 0].tolist()) == set(range(1, 9))
    assert set(sizes[objects == 1].tolist()) == {1, 2, 3}
    assert set(sizes[objects == 2].tolist()) == {1}


def test_one_seed_draws_alike():
    with seeded_generator(4) as one:
        first = torch.rand(3, generator=one), torch.rand(3)
    with seeded_generator(4) as other:
        second = torch.rand(3, generator=other), torch.rand(3)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
