"""Distillation of the candidate encoder: its loss, its data, its agreement with exhaustive search, and invariants."""

import dataclasses

import numpy as np
import pytest
import torch

from retrieval.data.dataset import load_grasps, make_split
from retrieval.errors import NumericalError
from retrieval.methods.late_fusion import LateFusion
from retrieval.methods.method import MethodSettings
from retrieval.methods.retrieve_rerank import RetrieveRerank
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint
from retrieval.model.config import Config, MatcherConfig, TrainingConfig
from retrieval.model.fusion import Matcher
from retrieval.training import distil
from retrieval.training.features import Features, encode_recording
from retrieval.training.initial_weights import build_matcher
from tests.conftest import TINY

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
    distil.distil(matcher, *partials, config_with_encoder(steps, seed), quiet=True)
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


def test_a_loss_that_is_not_finite_is_an_error_and_the_matcher_is_unchanged(matcher, partials):
    with torch.no_grad():
        matcher.head.out.bias.fill_(torch.inf)
    with pytest.raises(NumericalError, match="loss must stay finite"):
        distilled(matcher, partials)
    assert matcher.candidate_encoder is None
    assert matcher.config == WITHOUT_CANDIDATE_ENCODER


# Its data --------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_a_blend_of_partials_is_the_partial_of_blended_features(matcher):
    features = torch.randn(5, matcher.photo_tower.feature_count)
    rows, partials = (
        distil.blend(part, 50, torch.Generator().manual_seed(1))
        for part in (features, matcher.photo_encoding(features).partial)
    )
    torch.testing.assert_close(matcher.photo_encoding(rows).partial, partials, rtol=1e-4, atol=1e-5)


def test_photos_of_the_pool_are_nearer_to_the_touches_than_random_blends_until_it_is_renewed(matcher, partials):
    distilled(matcher, partials)
    encoder, touches = matcher.candidate_encoder, partials[0][:16]
    sampler = distil.PhotoSampler(encoder, partials[1], lambda rows: rows, torch.Generator().manual_seed(2))
    steps = (-1, 0, 1, distil.POOL_RENEWAL_STEPS)
    random_only, pooled, again, renewed = (sampler.photos(step, touches) for step in steps)
    assert random_only.shape == pooled.shape == (256, HIDDEN)
    random_similarity, pooled_similarity = (
        (encoder.touch(touches) @ encoder.photo(photos).T).topk(12).values.mean() for photos in (random_only, pooled)
    )
    assert pooled_similarity > random_similarity
    rows, same_pool, other_pool = ({tuple(row.tolist()) for row in photos} for photos in (pooled, again, renewed))
    assert rows & same_pool
    assert not rows & other_pool


# The distilled encoder -------------------------------------------------------------------------------------


def test_the_exhaustive_top1_is_among_few_candidates_only_after_training(matcher, partials):
    """The touches are not in the training data; there are 400 photos."""
    unseen = drawn(100, 8, sign=1)
    distilled(matcher, partials, steps=1)
    before = distil.exhaustive_top1_ranks(matcher, unseen, partials[1])
    distilled(matcher, partials, steps=60)
    after = distil.exhaustive_top1_ranks(matcher, unseen, partials[1])
    assert (before < 40).mean() < 0.3
    assert (after < 40).mean() > 0.8


def test_the_rank_of_the_exhaustive_top1_counts_the_photos_nearer_than_it(matcher, partials):
    distilled(matcher, partials)
    touches, photos = partials[0][:10], partials[1]
    ranks = distil.exhaustive_top1_ranks(matcher, touches, photos)
    for touch, rank in zip(touches, ranks, strict=True):
        logits = [matcher.head(touch[None], photo[None]).item() for photo in photos]
        encoder = matcher.candidate_encoder
        similarity = (encoder.touch(touch[None]) @ encoder.photo(photos).T)[0].tolist()
        assert rank == sum(one > similarity[int(np.argmax(logits))] for one in similarity)


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


def test_with_a_cosine_in_the_logit_linear_values_rank_the_top1_higher_than_a_network_alone(partials):
    """The logit is only the cosine of embeddings that vary in two directions."""
    torch.manual_seed(3)
    config = dataclasses.replace(WITHOUT_CANDIDATE_ENCODER, cosine=True)
    matcher = Matcher(config).eval()
    with torch.no_grad():
        matcher.head.out.weight.zero_()
    touches, photos = (
        torch.cat([part, sign * 2 * torch.nn.functional.normalize(part[:, :8])], dim=1)
        for part, sign in zip(partials, (1, -1), strict=True)
    )
    ranks = []
    for linear in (0, 2):
        sizes = config_with_encoder(3, candidate_linear=linear, cosine=True)
        distil.distil(matcher, touches, photos, sizes, quiet=True)
        assert matcher.config == dataclasses.replace(config, candidate_width=32, candidate_linear=linear)
        ranks.append(distil.exhaustive_top1_ranks(matcher, touches, photos).mean())
    assert ranks[1] < ranks[0] / 2


# Into a checkpoint -----------------------------------------------------------------------------------------


@pytest.fixture
def checkpoint(matcher, tmp_path):
    about = {"step": 1, "source": "test", "data_digest": "0", "metrics": {"validation_auc": 0.75}}
    config = Config(WITHOUT_CANDIDATE_ENCODER)
    return Checkpoint(tmp_path / "m.safetensors", digest="", matcher=matcher, config=config, provenance=about)


def test_a_checkpoint_gets_a_candidate_encoder_and_with_validation_objects_queries_and_a_metric(checkpoint, partials):
    held_out = drawn(30, 8, sign=1), drawn(50, 9, sign=-1)
    assert not checkpoint.config.has_embeddings
    made = distil.with_candidate_encoder(checkpoint, config_with_encoder(), partials, held_out, quiet=True)
    store_checkpoint(made, made.path)
    made = load_checkpoint(made.path)
    assert made.config == config_with_encoder()
    assert made.config.has_embeddings
    np.testing.assert_array_equal(made.queries, held_out[0].half().numpy())
    ranks = distil.exhaustive_top1_ranks(
        made.matcher, torch.from_numpy(made.queries).float(), torch.cat([partials[1], held_out[1]])
    )
    metrics = made.provenance["metrics"]
    assert metrics == {"validation_auc": 0.75, "candidate_agreement_at_1_percent": (ranks < 4).mean()}
    assert "candidate agreement at 1 percent" in made.path.with_suffix(".md").read_text()
    without = distil.with_candidate_encoder(checkpoint, config_with_encoder(2), partials, quiet=True)
    assert (without.queries, without.provenance["metrics"]) == (None, {"validation_auc": 0.75})


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


# In the harness --------------------------------------------------------------------------------------------


def test_with_a_candidate_encoder_the_best_candidate_is_mostly_late_fusions_best_photo(recording, tmp_path):
    training = dataclasses.replace(TINY.training, freeze_towers=True, distil_steps=60, iterations=30)
    config = dataclasses.replace(TINY, matcher=dataclasses.replace(TINY.matcher, candidate_width=32), training=training)
    grasps = load_grasps(recording)
    torch.manual_seed(0)
    features = encode_recording(grasps, build_matcher(config).eval(), config, None, quiet=True)
    split = make_split(grasps, validation=0.25, test=0.2, seed=0)
    parts = [features.of_objects(part) for part in (split.train, split.validation)]
    best = []
    for kind in (LateFusion, RetrieveRerank):
        method = kind(MethodSettings(config, folder=tmp_path))
        method.fit(*parts)
        best.append(method.score(method.encode_touch(features.touch), method.encode_photo(features.photo)).argmax(1))
    assert method.best_params["reranked_fraction"] == 0.25
    assert (best[0] == best[1]).mean() > 0.8  # the best photo may be outside the reranked quarter


def test_partial_activations_of_parts_are_those_of_all_features(matcher, monkeypatch):
    names, count = tuple(map(str, range(7))), matcher.touch_tower.feature_count
    touch, photo = np.random.default_rng(0).normal(size=(2, 7, count)).astype(np.float32)
    features = Features(names, names, touch[:, None], photo)
    expected = distil.feature_partials(matcher, features)
    monkeypatch.setattr(distil, "ROWS", 3)
    torch.testing.assert_close(distil.feature_partials(matcher, features), expected)
