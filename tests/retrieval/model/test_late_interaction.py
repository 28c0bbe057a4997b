"""Late interaction: cells of a tower's map, their vectors, and scores of every touch with every photo."""

import numpy as np
import pytest
import torch

from retrieval.errors import ConfigError
from retrieval.model.config import MatcherConfig
from retrieval.model.fusion import Matcher
from retrieval.model.late_interaction import cell_scores, paired_cell_scores
from retrieval.model.losses.listwise import PooledListwiseLoss, listwise_loss
from retrieval.model.losses.loss import EncodedBatch
from retrieval.model.towers.tower import build_tower

CELLS = MatcherConfig(
    "small",
    "stages",
    hidden=16,
    standardise=True,
    embedding_dim=8,
    projection_hidden=12,
    cosine=True,
    cell_dim=4,
    touch_cells=2,
    photo_cells=3,
)


@pytest.fixture
def matcher():
    torch.manual_seed(0)
    return Matcher(CELLS, views=2).eval()


@pytest.fixture
def images():
    torch.manual_seed(1)
    return torch.rand(3, 2, 3, 64, 64), torch.rand(5, 3, 96, 192)


def test_a_score_is_the_sum_of_the_largest_products_of_two_plain_loops():
    touches = torch.tensor([[[1.0, 0.0], [0.0, 2.0]]])
    photos = torch.tensor([[[3.0, 1.0], [1.0, 4.0]], [[0.0, -1.0], [-2.0, -3.0]]])
    # First photo: max(3, 1) + max(2, 8). Second photo: max(0, -2) + max(-2, -6).
    assert cell_scores(touches, photos).tolist() == [[11.0, -2.0]]
    assert paired_cell_scores(touches, photos).tolist() == [11.0, -2.0]


def test_cells_are_the_means_of_the_map_row_by_row():
    tower = build_tower("small", "stages").divide(2).eval()
    images = torch.rand(1, 3, 64, 64)
    _, maps = tower._encode_with_map((images - tower.mean) / tower.std)  # (1, 128, 4, 4)
    cells = tower(images)[0, tower.feature_count :].view(4, tower.cell_channels)
    torch.testing.assert_close(cells[1], maps[0, :, :2, 2:].mean((1, 2)))
    torch.testing.assert_close(cells[2], maps[0, :, 2:, :2].mean((1, 2)))


def test_a_tower_without_cells_is_refused_by_name():
    with pytest.raises(ConfigError, match="has no cells"):
        build_tower("resnet18", "stages").divide(4)
    with pytest.raises(ConfigError, match="stages"):
        MatcherConfig("mobilenet_v2", "pooled", cell_dim=8)


def test_logits_of_every_pair_equal_those_of_single_pairs_and_those_in_numpy(matcher, images):
    with torch.inference_mode():
        touch = matcher.touch_encoding(matcher.touch_features(images[0])).partial
        photo = matcher.photo_encoding(matcher.photo_features(images[1])).partial
        table = matcher.head.all_logits(touch, photo)
    assert touch.shape[1] == CELLS.touch_partial_width
    assert photo.shape[1] == CELLS.partial_width
    lengths = [part[:, CELLS.pooled_width :].reshape(-1, CELLS.cell_dim).norm(dim=1) for part in (touch, photo)]
    assert 0 < lengths[0].min() < lengths[0].max()  # a touch cell's length is its weight
    torch.testing.assert_close(lengths[1], torch.ones_like(lengths[1]))
    for row in range(3):
        torch.testing.assert_close(table[row], matcher.head(touch[row][None], photo), rtol=1e-5, atol=1e-5)
        numpy = matcher.head.scorer.logits(touch[row][None].numpy(), photo.numpy())
        np.testing.assert_allclose(numpy, table[row], rtol=1e-5, atol=1e-5)


def test_the_vector_of_a_cell_depends_on_its_place_and_on_the_whole_image(matcher):
    cells = torch.rand(1, 1, matcher.photo_tower.cell_channels).expand(2, 9, -1)  # the same in all places
    features = torch.rand(2, matcher.pooled_counts[1])
    assert torch.allclose(*(matcher.photo_cells(cells, features)[0, place] for place in (0, 1)))  # places start equal
    torch.nn.init.normal_(matcher.photo_cells.place)
    first, second = matcher.photo_cells(cells, features)
    assert not torch.allclose(first[0], first[1])
    assert not torch.allclose(first[0], second[0])


def test_the_pooled_listwise_loss_is_that_of_the_matcher_without_cells_and_trains_no_cell(matcher, images):
    touch = matcher.touch_encoding(matcher.touch_features(images[0]))
    photo = matcher.photo_encoding(matcher.photo_features(images[1][:3]))
    objects = torch.arange(3)
    loss = PooledListwiseLoss(8, 3)(EncodedBatch(matcher, touch, photo, objects, objects))
    pooled = matcher.without_cells()
    without_cells = pooled(images[0].repeat_interleave(3, 0), images[1][:3].repeat(3, 1, 1, 1)).view(3, 3)
    torch.testing.assert_close(loss, listwise_loss(without_cells, objects, objects))
    loss.backward()
    cells = [*matcher.touch_cells.parameters(), *matcher.photo_cells.parameters()]
    assert all(parameter.grad is None or not parameter.grad.any() for parameter in cells)
    assert matcher.head.second.weight.grad.abs().sum() > 0
