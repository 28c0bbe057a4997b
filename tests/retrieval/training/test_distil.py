"""Distillation of the candidate encoder: its loss, its data, its agreement with exhaustive search, and queries."""

import dataclasses

import numpy as np
import pytest
import torch

from retrieval.model.config import Config, MatcherConfig, TrainingConfig
from retrieval.model.fusion import Matcher
from retrieval.training import distil

HIDDEN = 16
WITHOUT_CANDIDATE_ENCODER = MatcherConfig(tower="small", fingers=1, hidden=HIDDEN, standardise=True, embedding_dim=8)


@pytest.fixture
def matcher():
    """A matcher whose head returns minus the sum of |t - v|, each as relu(t - v) + relu(v - t)."""
    torch.manual_seed(3)
    matcher = Matcher(WITHOUT_CANDIDATE_ENCODER).eval()
    with torch.no_grad():
        matcher.head.second.weight.copy_(torch.eye(HIDDEN))
        matcher.head.second.bias.zero_()
        matcher.head.out.weight.fill_(-1.0)
    return matcher


@pytest.fixture(autouse=True)
def _small_batches(monkeypatch):
    monkeypatch.setattr(distil, "BATCH_TOUCHES", 16)
    monkeypatch.setattr(distil, "BATCH_PHOTOS", 256)
    monkeypatch.setattr(distil, "POOL_SIZE", 2000)
    monkeypatch.setattr(distil, "LEARNING_RATE", 0.02)


def drawn(count, seed, sign):
    """Return partial activations that vary in two directions, of touches (sign 1) or photos (sign -1)."""
    directions = torch.randn(2, HIDDEN // 2, generator=torch.Generator().manual_seed(4))
    values = torch.randn(count, 2, generator=torch.Generator().manual_seed(seed)) @ directions
    return sign * torch.cat([values, -values], dim=1)


@pytest.fixture
def partials():
    return drawn(60, 5, sign=1), drawn(400, 6, sign=-1)


def config_with_encoder(steps=20, seed=0, **sizes):
    matcher = dataclasses.replace(WITHOUT_CANDIDATE_ENCODER, candidate_width=32, **sizes)
    return Config(matcher, TrainingConfig(distil_steps=steps, seed=seed))


def distilled(matcher, partials, steps=5, seed=0):
    distil.distil(matcher, *partials, config_with_encoder(steps, seed))
    return {name: tensor.clone() for name, tensor in matcher.candidate_encoder.state_dict().items()}


def same(left, right):
    return all(torch.equal(left[name], right[name]) for name in left)


# The loss --------------------------------------------------------------------------------------------------


def test_the_loss_is_the_divergence_plus_the_weighted_error():
    scores, logits = np.array([[0.0, 1.0], [2.0, 2.0]]), np.array([[1.0, 0.0], [3.0, 5.0]])
    targets = [np.exp(row) / np.exp(row).sum() for row in logits]
    student = [np.exp(row) / np.exp(row).sum() for row in scores]
    divergence = np.mean([(p * np.log(p / q)).sum() for p, q in zip(targets, student, strict=True)])
    centred = [row - row.mean() for row in scores], [row - row.mean() for row in logits]
    error = np.mean((np.array(centred[0]) - np.array(centred[1])) ** 2) / logits.var(ddof=1)
    loss = distil.distillation_loss(torch.tensor(scores), torch.tensor(logits))
    assert loss.item() == pytest.approx(divergence + distil.SQUARED_ERROR_WEIGHT * error)


# Its data --------------------------------------------------------------------------------------------------


def test_photos_of_the_pool_are_nearer_to_the_touches_than_random_blends(matcher, partials):
    distilled(matcher, partials)
    encoder, touches = matcher.candidate_encoder, partials[0][:16]
    sampler = distil.PhotoSampler(encoder, partials[1], lambda rows: rows, torch.Generator().manual_seed(2))
    random_only, pooled = (sampler.photos(step, touches) for step in (-1, 0))
    assert random_only.shape == pooled.shape == (256, HIDDEN)
    random_similarity, pooled_similarity = (
        (encoder.touch(touches) @ encoder.photo(photos).T).topk(12).values.mean() for photos in (random_only, pooled)
    )
    assert pooled_similarity > random_similarity


# The distilled encoder -------------------------------------------------------------------------------------


def test_the_exhaustive_top1_is_among_few_candidates_only_after_training(matcher, partials):
    touches, photos = drawn(100, 8, sign=1), partials[1]
    found = []
    for steps in (1, 60):
        distilled(matcher, partials, steps)
        encoder = matcher.candidate_encoder
        with torch.inference_mode():
            best = matcher.head.all_logits(touches, photos).argmax(1)
            nearest = (encoder.touch(touches) @ encoder.photo(photos).T).topk(40).indices
        found.append((nearest == best[:, None]).any(1).float().mean())
    assert found[0] < 0.3
    assert found[1] > 0.8


def test_only_the_candidate_encoder_changes_and_depends_on_the_seed_alone(matcher, partials):
    before = {name: tensor.clone() for name, tensor in matcher.state_dict().items()}
    first = distilled(matcher, partials)
    after, state = matcher.state_dict(), torch.get_rng_state()
    assert same(before, after)
    assert {name.split(".")[0] for name in after.keys() - before.keys()} == {"candidate_encoder"}
    assert matcher.config == dataclasses.replace(WITHOUT_CANDIDATE_ENCODER, candidate_width=32)
    assert same(distilled(matcher, partials), first)  # also after an earlier distillation
    assert torch.equal(torch.get_rng_state(), state)
    assert not same(distilled(matcher, partials, seed=1), first)


# Queries -----------------------------------------------------------------------------------------


def test_queries_are_limited_in_number_and_finite_in_float16():
    partials = torch.arange(1200.0)[:, None] * torch.ones(1, 2)
    partials[7, 1] = 70_000.0
    queries = distil.select_queries(partials, seed=0)
    assert queries.dtype == np.float16
    assert queries.shape == (distil.MAX_QUERIES, 2)
    assert len(np.unique(queries[:, 0])) == distil.MAX_QUERIES
    assert np.isfinite(queries).all()
    np.testing.assert_array_equal(queries, distil.select_queries(partials, seed=0))
    assert partials.half()[7, 1].isinf()
    assert distil.select_queries(partials[7:8], seed=0) is None
