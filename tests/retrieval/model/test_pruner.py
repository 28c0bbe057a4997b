"""The pruner: unit embeddings of halves, in the order of the scores that are taught."""

import pytest
import torch

from retrieval.model.config import MatcherConfig
from retrieval.model.fusion import Matcher
from retrieval.model.pruner import Pruner, Spread


def made(hidden=6, width=8, dim=4, seed=0, linear=0):
    torch.manual_seed(seed)
    return Pruner(hidden, width, dim, linear), 3 + 5 * torch.randn(7, hidden), 2 * torch.randn(9, hidden) - 1


def test_embeddings_have_norm_1_and_a_half_of_zeros_gives_one_too():
    pruner, touches, photos = made()
    for embeddings in (pruner.touch(touches), pruner.photo(photos), pruner.photo(torch.zeros(1, 6))):
        torch.testing.assert_close(embeddings.norm(dim=1), torch.ones(len(embeddings)))


def test_photos_stand_in_the_order_of_the_taught_scores_though_an_embedding_has_lost_its_length():
    pruner, touches, photos = made()
    nearness, scores = pruner.touch(touches) @ pruner.photo(photos).T, pruner.scores(touches, photos)
    assert torch.equal(nearness.argsort(1), scores.argsort(1))
    assert not torch.allclose(nearness, scores)


@pytest.mark.parametrize("linear", [0, 3])
def test_a_pruner_that_learned_from_scaled_halves_reads_them_as_they_are_once_it_took_that_in(linear):
    pruner, touches, photos = made(linear=linear)
    spreads = Spread.of(touches, 4), Spread.of(photos, 4)
    pruner.begin_with_axes(photos, *spreads)
    taught = pruner.scores(spreads[0](touches), spreads[1](photos))
    assert not torch.allclose(pruner.scores(touches, photos), taught, atol=1e-2)  # as they are, too early
    pruner.absorb(*spreads)
    torch.testing.assert_close(pruner.scores(touches, photos), taught, rtol=1e-4, atol=1e-5)


def test_linear_numbers_begin_with_the_cosine_as_far_as_so_many_axes_hold_it_and_a_network_has_the_rest_to_learn():
    """Embeddings of six numbers that vary in two directions: two axes hold all of it, whatever the first two numbers
    of a half, its share, are."""
    torch.manual_seed(1)
    mixed, share = torch.randn(2, 6), 40 * torch.randn(30, 2)
    halves = torch.cat([share, 0.2 * torch.randn(30, 2) @ mixed + torch.randn(6)], dim=1)
    touches, photos = halves[:10], halves[10:]
    spreads = Spread.of(touches, 6), Spread.of(photos, 6)
    pruner = Pruner(8, 5, 6, linear=2)
    pruner.begin_with_axes(photos, *spreads)
    pruner.absorb(*spreads)
    both = [
        pruner.get_submodule(f"_{side}_axes")(part[:, 2:]) for side, part in (("touch", touches), ("photo", photos))
    ]
    axes, cosines = both[0] @ both[1].T, touches[:, 2:] @ photos[:, 2:].T
    apart = [table - table.mean(1, keepdim=True) for table in (axes, cosines)]
    torch.testing.assert_close(apart[0], apart[1], rtol=1e-3, atol=1e-4)
    assert both[1].norm(dim=1).mean().item() == pytest.approx(1, rel=1e-4)


def test_an_embedding_at_the_end_of_halves_has_a_scale_of_its_own():
    """By one scale for all, what is a thousand times smaller would be lost to the network that reads it."""
    halves = torch.tensor([[0.0, 1000.0, 0.1], [2000.0, 1000.0, 0.3]])
    spread = Spread.of(halves, 1)
    share = ((0 - 1000) ** 2 + (2000 - 1000) ** 2) ** 0.5 / 2
    torch.testing.assert_close(spread.scale, torch.tensor([share, share, 0.1]))
    torch.testing.assert_close(spread(halves)[:, 2], torch.tensor([-1.0, 1.0]))
    assert Spread.of(halves)(halves)[:, 2].abs().max() < 1e-3


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
