"""The pruner: unit embeddings of halves, in the order of the scores that are taught."""

import torch

from retrieval.model.config import MatcherConfig
from retrieval.model.fusion import Matcher
from retrieval.model.pruner import Pruner, Spread


def made(hidden=6, width=8, dim=4, seed=0):
    torch.manual_seed(seed)
    return Pruner(hidden, width, dim), 3 + 5 * torch.randn(7, hidden), 2 * torch.randn(9, hidden) - 1


def test_embeddings_have_norm_1_and_a_half_of_zeros_gives_one_too():
    pruner, touches, photos = made()
    for embeddings in (pruner.touch(touches), pruner.photo(photos), pruner.photo(torch.zeros(1, 6))):
        torch.testing.assert_close(embeddings.norm(dim=1), torch.ones(len(embeddings)))


def test_photos_stand_in_the_order_of_the_taught_scores_though_an_embedding_has_lost_its_length():
    pruner, touches, photos = made()
    nearness, scores = pruner.touch(touches) @ pruner.photo(photos).T, pruner.scores(touches, photos)
    assert torch.equal(nearness.argsort(1), scores.argsort(1))
    assert not torch.allclose(nearness, scores)


def test_a_pruner_that_learned_from_scaled_halves_reads_them_as_they_are_once_it_took_that_in():
    pruner, touches, photos = made()
    spreads = Spread.of(touches), Spread.of(photos)
    taught = pruner.scores(spreads[0](touches), spreads[1](photos))
    assert not torch.allclose(pruner.scores(touches, photos), taught, atol=1e-2)  # as they are, too early
    pruner.absorb(*spreads)
    torch.testing.assert_close(pruner.scores(touches, photos), taught, rtol=1e-4, atol=1e-5)


def test_halves_are_centred_by_unit_and_scaled_by_one_number():
    halves = torch.tensor([[0.0, 10.0], [2.0, 14.0]])
    spread = Spread.of(halves)
    assert spread.mean.tolist() == [1.0, 12.0]
    scale = (((0 - 6.5) ** 2 + (10 - 6.5) ** 2 + (2 - 6.5) ** 2 + (14 - 6.5) ** 2) / 4) ** 0.5
    torch.testing.assert_close(spread(halves), (halves - torch.tensor([1.0, 12.0])) / scale)


def test_halves_that_do_not_vary_stay_finite_where_a_bare_division_gives_nan():
    halves = torch.full((3, 2), 5.0)
    assert (halves - halves.mean(0)).div(halves.std(correction=0)).isnan().all()
    assert Spread.of(halves)(halves).tolist() == [[0.0, 0.0]] * 3


def test_entries_carry_the_pruners_embedding_and_without_one_the_contrastive_one():
    for width in (0, 8):
        torch.manual_seed(0)
        matcher = Matcher(MatcherConfig(tower="small", hidden=6, embedding_dim=4, pruner_width=width)).eval()
        features = torch.randn(2, matcher.photo_tower.feature_count)
        code, entry = matcher.photo_code(features), matcher.photo_entry(features)
        assert torch.equal(code.half, entry.half)
        expected = code.embedding if matcher.pruner is None else matcher.pruner.photo(code.half)
        assert (matcher.pruner is None) == (width == 0)
        assert torch.equal(entry.embedding, expected)
        assert torch.equal(entry.embedding, code.embedding) == (width == 0)
