"""Both loss terms against plain loops, and where the naive formulae fail."""

import math

import pytest
import torch

from retrieval.losses import LOG_SCALE_MAX, contrastive_loss, match_loss


def unit(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(*shape, generator=generator, dtype=torch.float64), dim=-1)


def loss_by_loops(scores, rows, columns):
    """For each row with a positive and a negative: the mean over positives of -log softmax among the negatives."""
    total = []
    for i, row in enumerate(rows):
        negatives = [math.exp(scores[i][j]) for j, column in enumerate(columns) if column != row]
        positives = [math.exp(scores[i][j]) for j, column in enumerate(columns) if column == row]
        if negatives and positives:
            total.append(sum(-math.log(p / (p + sum(negatives))) for p in positives) / len(positives))
    return sum(total) / len(total)


def test_the_contrastive_loss_is_what_plain_loops_give():
    touch, photo = unit(4, 8), unit(6, 8, seed=1)
    touch_objects, photo_objects = torch.tensor([0, 1, 1, 2]), torch.tensor([0, 0, 1, 2, 3, 1])
    scale = torch.tensor(math.log(5.0))
    scores = (5.0 * touch @ photo.T).tolist()
    rows, columns = touch_objects.tolist(), photo_objects.tolist()
    transposed = [list(column) for column in zip(*scores, strict=True)]
    expected = (loss_by_loops(scores, rows, columns) + loss_by_loops(transposed, columns, rows)) / 2
    got = contrastive_loss(touch, photo, touch_objects, photo_objects, scale)
    assert got.item() == pytest.approx(expected, rel=1e-5)  # float32 inside


def test_photos_of_one_object_are_never_negatives_of_each_other():
    """Two identical photos of the same object: as negatives of each other they would cost log 2."""
    touch = torch.tensor([[1.0, 0.0], [-1.0, 0.0]])
    photo = torch.tensor([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]])
    loss = contrastive_loss(touch, photo, torch.tensor([0, 1]), torch.tensor([0, 0, 1]), torch.tensor(LOG_SCALE_MAX))
    assert loss.item() < 1e-6
    naive = torch.nn.functional.cross_entropy(100 * touch[:1] @ photo.T, torch.tensor([0]))
    assert naive.item() == pytest.approx(math.log(2), rel=1e-5)


def test_a_batch_of_one_object_has_no_contrast_and_no_nan():
    touch = unit(3, 4).float().requires_grad_()
    same = torch.zeros(3, dtype=torch.long)
    loss = contrastive_loss(touch, unit(3, 4, seed=2).float(), same, same, torch.tensor(0.0))
    loss.backward()
    assert loss.item() == 0.0
    assert torch.equal(touch.grad, torch.zeros_like(touch))


def test_the_hardest_pair_at_the_largest_scale_keeps_its_loss_and_gradient():
    """Positive at cosine -1, negative at +1, scale 100: the loss is 200; log(num / den + tiny) would stick at 88."""
    touch = torch.tensor([[1.0, 0.0]], requires_grad=True)
    photo = torch.tensor([[-1.0, 0.0], [1.0, 0.0]])
    objects = torch.tensor([0]), torch.tensor([0, 1])
    loss = contrastive_loss(touch, photo, *objects, torch.tensor(LOG_SCALE_MAX))
    loss.backward()
    naive = -torch.log(torch.softmax(torch.tensor([-100.0, 100.0]), 0)[0] + torch.finfo(torch.float32).tiny)
    assert naive.item() < 88
    # 200 from touch to photo; nothing from photo to touch, where no photo has a touch of another object.
    assert loss.item() == pytest.approx(200.0 / 2, rel=1e-4)
    assert float(touch.grad.abs().sum()) > 50


def test_the_match_loss_is_exact_where_the_naive_formula_overflows():
    logits = torch.tensor([-120.0], requires_grad=True)
    naive = -torch.log(torch.sigmoid(logits))
    assert torch.isinf(naive).all()
    loss = match_loss(logits, torch.tensor([1.0]))
    loss.backward()
    assert loss.item() == pytest.approx(120.0)
    assert float(logits.grad) == pytest.approx(-1.0)


def test_the_match_loss_is_what_the_formula_says():
    logits, labels = torch.tensor([0.0, 2.0, -1.0]), torch.tensor([1.0, 0.0, 1.0])
    expected = (math.log(2) + math.log(1 + math.exp(2)) + math.log(1 + math.exp(1))) / 3
    assert match_loss(logits, labels).item() == pytest.approx(expected, rel=1e-6)
