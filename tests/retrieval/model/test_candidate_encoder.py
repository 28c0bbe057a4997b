"""The candidate encoder: unit embeddings of partial activations, in the order of the distilled scores."""

import pytest
import torch

from retrieval.model.candidate_encoder import CandidateEncoder, PartialStatistics


@pytest.mark.parametrize("linear", [0, 3])
def test_folded_statistics_give_raw_partial_activations_the_scores_of_standardised_ones(linear):
    torch.manual_seed(0)
    candidate_encoder, touches, photos = CandidateEncoder(6, 8, 4, linear), 3 + 5 * torch.randn(7, 6), torch.randn(9, 6)
    spreads = PartialStatistics.of(touches, 4), PartialStatistics.of(photos, 4)
    candidate_encoder.initialise_linear(photos, *spreads)
    expected = candidate_encoder.scores(spreads[0](touches), spreads[1](photos))
    assert not torch.allclose(candidate_encoder.scores(touches, photos), expected, atol=1e-2)  # not folded yet
    candidate_encoder.fold_statistics(*spreads)
    torch.testing.assert_close(candidate_encoder.scores(touches, photos), expected, rtol=1e-4, atol=1e-5)


def test_linear_components_start_as_the_cosine_in_so_many_principal_axes():
    """Embeddings of six numbers that vary in two directions: two axes contain all of the cosine.

    The first two numbers of a partial activation, the head's term, do not matter.
    """
    torch.manual_seed(1)
    mixed, terms = torch.randn(2, 6), 40 * torch.randn(30, 2)
    partials = torch.cat([terms, 0.2 * torch.randn(30, 2) @ mixed + torch.randn(6)], dim=1)
    touches, photos = partials[:10], partials[10:]
    spreads = PartialStatistics.of(touches, 6), PartialStatistics.of(photos, 6)
    candidate_encoder = CandidateEncoder(8, 5, 6, linear=2)
    candidate_encoder.initialise_linear(photos, *spreads)
    candidate_encoder.fold_statistics(*spreads)
    both = [
        candidate_encoder.get_submodule(f"{side}_linear")(part[:, 2:])
        for side, part in (("touch", touches), ("photo", photos))
    ]
    axes, cosines = both[0] @ both[1].T, touches[:, 2:] @ photos[:, 2:].T
    apart = [table - table.mean(1, keepdim=True) for table in (axes, cosines)]
    torch.testing.assert_close(apart[0], apart[1], rtol=1e-3, atol=1e-4)
    assert both[1].norm(dim=1).mean().item() == pytest.approx(1, rel=1e-4)


def test_an_embedding_at_the_end_of_partial_activations_has_its_own_scale():
    """With one scale for all, the network would not use values that are a thousand times smaller."""
    partials = torch.tensor([[0.0, 1000.0, 0.1], [2000.0, 1000.0, 0.3]])
    spread = PartialStatistics.of(partials, 1)
    deviation = ((0 - 1000) ** 2 + (2000 - 1000) ** 2) ** 0.5 / 2
    torch.testing.assert_close(spread.scale, torch.tensor([deviation, deviation, 0.1]))
    torch.testing.assert_close(spread(partials)[:, 2], torch.tensor([-1.0, 1.0]))
    assert PartialStatistics.of(partials, 0)(partials)[:, 2].abs().max() < 1e-3


def test_constant_partial_activations_stay_finite_where_a_plain_division_gives_nan():
    partials = torch.full((3, 2), 5.0)
    assert (partials - partials.mean(0)).div(partials.std(correction=0)).isnan().all()
    assert PartialStatistics.of(partials, 0)(partials).tolist() == [[0.0, 0.0]] * 3
