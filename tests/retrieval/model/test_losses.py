"""The contrastive loss against plain loops, and at half precision."""

import math

import pytest
import torch

from retrieval.model.fusion import LOG_SCALE_MAX
from retrieval.model.losses.listwise import contrastive_loss


def unit(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(*shape, generator=generator, dtype=torch.float64), dim=-1)


def loss_by_loops(scores, rows, columns):
    """Return the mean over rows, with a positive and a negative, of -log softmax of positives among the negatives."""
    total = []
    for i, row in enumerate(rows):
        negatives = [math.exp(scores[i][j]) for j, column in enumerate(columns) if column != row]
        positives = [math.exp(scores[i][j]) for j, column in enumerate(columns) if column == row]
        if negatives and positives:
            total.append(sum(-math.log(p / (p + sum(negatives))) for p in positives) / len(positives))
    return sum(total) / len(total)


def test_the_contrastive_loss_equals_that_of_plain_loops():
    touch, photo = unit(4, 8), unit(6, 8, seed=1)
    touch_objects, photo_objects = torch.tensor([0, 1, 1, 2]), torch.tensor([0, 0, 1, 2, 3, 1])
    scale = torch.tensor(math.log(5.0))
    scores = (5.0 * touch @ photo.T).tolist()
    rows, columns = touch_objects.tolist(), photo_objects.tolist()
    transposed = [list(column) for column in zip(*scores, strict=True)]
    expected = (loss_by_loops(scores, rows, columns) + loss_by_loops(transposed, columns, rows)) / 2
    got = contrastive_loss(touch, photo, touch_objects, photo_objects, scale)
    assert got.item() == pytest.approx(expected, rel=1e-5)  # float32 inside


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_embeddings_lose_only_their_own_rounding(dtype):
    touch, photo = unit(5, 16), unit(6, 16, seed=1)
    labels = torch.tensor([0, 1, 2, 3, 3]), torch.tensor([0, 1, 2, 3, 3, 4])
    scale = torch.tensor(LOG_SCALE_MAX)
    rounded = contrastive_loss(touch.to(dtype), photo.to(dtype), *labels, scale)
    exact = contrastive_loss(touch.to(dtype).double(), photo.to(dtype).double(), *labels, scale)
    assert rounded.dtype == torch.float32
    assert rounded.item() == pytest.approx(exact.item(), rel=1e-5)  # the sums are in float32
    touch, photo = touch.to(dtype), photo.to(dtype)
    naive = (100 * touch @ photo.T).double() - 100 * touch.double() @ photo.double().T  # sums in half precision
    assert naive.abs().max() > 0.005
