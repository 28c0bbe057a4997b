"""The candidate_encoder: unit embeddings of halves, in the order of the scores that are taught."""

import pytest
import torch

from retrieval.model.candidate_encoder import CandidateEncoder, PartialStatistics
from retrieval.model.config import MatcherConfig
from retrieval.model.fusion import Matcher


def made(hidden=6, width=8, dim=4, seed=0, linear=0):
    torch.manual_seed(seed)
    return CandidateEncoder(hidden, width, dim, linear), 3 + 5 * torch.randn(7, hidden), 2 * torch.randn(9, hidden) - 1


def test_embeddings_have_norm_1_and_a_half_of_zeros_gives_one_too():
    candidate_encoder, touches, photos = made()
    for embeddings in (
        candidate_encoder.touch(touches),
        candidate_encoder.photo(photos),
        candidate_encoder.photo(torch.zeros(1, 6)),
    ):
        torch.testing.assert_close(embeddings.norm(dim=1), torch.ones(len(embeddings)))


def test_photos_stand_in_the_order_of_the_taught_scores_though_an_embedding_has_lost_its_length():
    candidate_encoder, touches, photos = made()
    nearness, scores = (
        candidate_encoder.touch(touches) @ candidate_encoder.photo(photos).T,
        candidate_encoder.scores(touches, photos),
    )
    assert torch.equal(nearness.argsort(1), scores.argsort(1))
    assert not torch.allclose(nearness, scores)


@pytest.mark.parametrize("linear", [0, 3])
def test_a_pruner_that_learned_from_scaled_halves_reads_them_as_they_are_once_it_took_that_in(linear):
    candidate_encoder, touches, photos = made(linear=linear)
    spreads = PartialStatistics.of(touches, 4), PartialStatistics.of(photos, 4)
    candidate_encoder.initialise_linear(photos, *spreads)
    taught = candidate_encoder.scores(spreads[0](touches), spreads[1](photos))
    assert not torch.allclose(candidate_encoder.scores(touches, photos), taught, atol=1e-2)  # as they are, too early
    candidate_encoder.fold_statistics(*spreads)
    torch.testing.assert_close(candidate_encoder.scores(touches, photos), taught, rtol=1e-4, atol=1e-5)


def test_linear_numbers_begin_with_the_cosine_as_far_as_so_many_axes_hold_it_and_a_network_has_the_rest_to_learn():
    """Embeddings of six numbers that vary in two directions: two axes hold all of it, whatever the first two numbers
    of a half, its share, are."""
    torch.manual_seed(1)
    mixed, share = torch.randn(2, 6), 40 * torch.randn(30, 2)
    partials = torch.cat([share, 0.2 * torch.randn(30, 2) @ mixed + torch.randn(6)], dim=1)
    touches, photos = partials[:10], partials[10:]
    spreads = PartialStatistics.of(touches, 6), PartialStatistics.of(photos, 6)
    candidate_encoder = CandidateEncoder(8, 5, 6, linear=2)
    candidate_encoder.initialise_linear(photos, *spreads)
    candidate_encoder.fold_statistics(*spreads)
    both = [
        candidate_encoder.get_submodule(f"_{side}_axes")(part[:, 2:])
        for side, part in (("touch", touches), ("photo", photos))
    ]
    axes, cosines = both[0] @ both[1].T, touches[:, 2:] @ photos[:, 2:].T
    apart = [table - table.mean(1, keepdim=True) for table in (axes, cosines)]
    torch.testing.assert_close(apart[0], apart[1], rtol=1e-3, atol=1e-4)
    assert both[1].norm(dim=1).mean().item() == pytest.approx(1, rel=1e-4)


def test_an_embedding_at_the_end_of_halves_has_a_scale_of_its_own():
    """By one scale for all, what is a thousand times smaller would be lost to the network that reads it."""
    partials = torch.tensor([[0.0, 1000.0, 0.1], [2000.0, 1000.0, 0.3]])
    spread = PartialStatistics.of(partials, 1)
    share = ((0 - 1000) ** 2 + (2000 - 1000) ** 2) ** 0.5 / 2
    torch.testing.assert_close(spread.scale, torch.tensor([share, share, 0.1]))
    torch.testing.assert_close(spread(partials)[:, 2], torch.tensor([-1.0, 1.0]))
    assert PartialStatistics.of(partials)(partials)[:, 2].abs().max() < 1e-3


def test_halves_are_centred_by_unit_and_scaled_by_one_number():
    partials = torch.tensor([[0.0, 10.0], [2.0, 14.0]])
    spread = PartialStatistics.of(partials)
    assert spread.mean.tolist() == [1.0, 12.0]
    scale = (((0 - 6.5) ** 2 + (10 - 6.5) ** 2 + (2 - 6.5) ** 2 + (14 - 6.5) ** 2) / 4) ** 0.5
    torch.testing.assert_close(spread(partials), (partials - torch.tensor([1.0, 12.0])) / scale)


def test_halves_that_do_not_vary_stay_finite_where_a_bare_division_gives_nan():
    partials = torch.full((3, 2), 5.0)
    assert (partials - partials.mean(0)).div(partials.std(correction=0)).isnan().all()
    assert PartialStatistics.of(partials)(partials).tolist() == [[0.0, 0.0]] * 3


def test_entries_carry_the_pruners_embedding_and_without_one_the_contrastive_one():
    for width in (0, 8):
        torch.manual_seed(0)
        matcher = Matcher(MatcherConfig(tower="small", hidden=6, embedding_dim=4, candidate_width=width)).eval()
        features = torch.randn(2, matcher.photo_tower.feature_count)
        code, entry = matcher.photo_encoding(features), matcher.photo_search_encoding(features)
        assert torch.equal(code.partial, entry.partial)
        expected = (
            code.embedding if matcher.candidate_encoder is None else matcher.candidate_encoder.photo(code.partial)
        )
        assert (matcher.candidate_encoder is None) == (width == 0)
        assert torch.equal(entry.embedding, expected)
        assert torch.equal(entry.embedding, code.embedding) == (width == 0)
