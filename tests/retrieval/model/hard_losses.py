"""Losses at logits whose exponentials overflow, and gradients where square roots have none."""

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

from retrieval.methods.contrastive import Projections
from retrieval.model.losses.listwise import contrastive_loss, listwise_loss
from retrieval.model.losses.loss import match_loss
from retrieval.model.towers.tower import stage_statistics
from retrieval.training.distil import distillation_loss
from tests.hard_case import HardCase

_ONE = torch.tensor([0])
_HARD_SCALE = torch.tensor(100.0).log()


def hard_cases() -> Iterator[HardCase]:
    """Cases of the losses."""
    yield _sure_and_wrong()
    yield _half_precision_logit()
    yield _hard_negatives()
    yield _several_photos_of_an_object()
    yield _one_object()
    yield _listwise()
    yield _distilled_order()
    yield _runaway_scale()
    yield _constant_map()
    yield _zero_embedding()


def _with_slope(loss: Callable[[Tensor], Tensor], at: Tensor) -> tuple[float, list[float]]:
    """Value of a loss and its gradient there."""
    point = at.clone().requires_grad_()
    value = loss(point)
    (slope,) = torch.autograd.grad(value, point)
    return value.item(), slope.flatten().tolist()


def _text(value: float, slope: list[float]) -> str:
    return f"{value:.6g}, gradient {', '.join(f'{part:.3g}' for part in slope)}"


def _case(
    kernel: str,
    case: str,
    at: Tensor,
    naive: Callable[[Tensor], Tensor],
    ours: Callable[[Tensor], Tensor],
    must: tuple[float, list[float]],
) -> HardCase:
    """Return the case of a loss with a known value and gradient."""
    found = [_with_slope(loss, at) for loss in (naive, ours)]
    correct = [_near(value, must[0]) and all(map(_near, slope, must[1])) for value, slope in found]
    return HardCase(kernel, case, _text(*must), _text(*found[0]), _text(*found[1]), correct[1], correct[0])


def _near(value: float, must: float) -> bool:
    return abs(value - must) <= 1e-4 * max(abs(must), 1e-2)


def _sure_and_wrong() -> HardCase:
    """-log(sigmoid(z)) is -z here, with slope -1."""
    return _case(
        "match loss",
        "a true pair at logit -200",
        torch.tensor([-200.0]),
        lambda z: -torch.log(torch.sigmoid(z)).mean(),
        lambda z: match_loss(z, torch.ones(1)),
        (200.0, [-1.0]),
    )


def _half_precision_logit() -> HardCase:
    return _case(
        "match loss",
        "a false pair at logit 20, float16",
        torch.tensor([20.0], dtype=torch.float16),
        lambda z: -torch.log(1 - torch.sigmoid(z)).mean(),
        lambda z: match_loss(z, torch.zeros(1)),
        (20.0, [1.0]),
    )


def _hard_negatives() -> HardCase:
    """The photo of the object is opposite (cosine -1), those of two others equal the touch (cosine 1), scale 100.

    -log softmax is 200 + log 2 for the touch, and log 1 = 0 for its photo, which has no other touch to compare with.
    """
    photo = torch.tensor([[-1.0, 0.0], [1.0, 0.0], [1.0, 0.0]])
    objects = torch.tensor([0, 1, 2])

    def naive(touch: Tensor) -> Tensor:
        exponentials = (100 * touch @ photo.T).exp()
        return -torch.log(exponentials[0, 0] / exponentials.sum() + torch.finfo(torch.float32).tiny) / 2

    def ours(touch: Tensor) -> Tensor:
        return contrastive_loss(touch, photo, _ONE, objects, _HARD_SCALE)

    must = (200 + 0.693147) / 2, [100.0, 0.0]
    return _case("InfoNCE", "opposite photo, equal negatives", torch.tensor([[1.0, 0.0]]), naive, ours, must)


def _several_photos_of_an_object() -> HardCase:
    """Two touches and two photos of one object, two of another, all perfectly aligned: the loss must be 0."""
    touch, objects = torch.eye(2).repeat_interleave(2, 0), torch.tensor([0, 0, 1, 1])
    scores = 100 * touch @ touch.T
    naive = functional.cross_entropy(scores, torch.arange(4)).item()
    ours = contrastive_loss(touch, touch, objects, objects, _HARD_SCALE).item()
    expected = "0: photos of one object are no rivals"
    return HardCase(
        "InfoNCE", "two photos of each object", expected, f"{naive:.3g}", f"{ours:.3g}", ours < 1e-6, naive < 1e-6
    )


def _one_object() -> HardCase:
    """Without rivals the loss is 0. The naive mean is taken over no rows."""
    photo = torch.tensor([[0.0, 1.0]])

    def naive(touch: Tensor) -> Tensor:
        losses = -functional.log_softmax((touch @ photo.T).masked_fill(torch.ones(1, 1).bool(), -torch.inf), 1)
        return losses[torch.zeros(1, 1).bool()].mean() + 0 * touch.sum()

    def ours(touch: Tensor) -> Tensor:
        return contrastive_loss(touch, photo, _ONE, _ONE, _HARD_SCALE)

    return _case("InfoNCE", "a batch of one object", torch.tensor([[1.0, 0.0]]), naive, ours, (0.0, [0.0, 0.0]))


def _listwise() -> HardCase:
    """Match logits of one touch with a photo of its object (-1e4) and one of another (1e4)."""
    objects = torch.tensor([0, 1])

    def naive(scores: Tensor) -> Tensor:
        exponentials = scores.exp()
        return -torch.log(exponentials[0, 0] / exponentials.sum()) / 2

    def ours(scores: Tensor) -> Tensor:
        return listwise_loss(scores, _ONE, objects)

    must = 1e4, [-0.5, 0.5]
    return _case("listwise loss", "logits -1e4 and 1e4", torch.tensor([[-1e4, 1e4]]), naive, ours, must)


def _distilled_order() -> HardCase:
    """A student whose order is opposite to that of a teacher with logits 1e4 apart.

    Divergence 1e4, and 0.3 of the squared error 1e8 over the teacher's variance 5e7.
    """
    teacher = torch.tensor([[-1e4, 0.0]])

    def naive(scores: Tensor) -> Tensor:
        target, learned = (one.exp() / one.exp().sum(1, keepdim=True) for one in (teacher, scores))
        return (target * (target / learned).log()).sum(1).mean()

    def ours(scores: Tensor) -> Tensor:
        return distillation_loss(scores, teacher)

    must = 1e4 + 0.3 * 2, [1.0, -1.0]
    return _case(
        "candidate encoder loss", "student opposite to logits of 1e4", torch.tensor([[0.0, -1e4]]), naive, ours, must
    )


def _runaway_scale() -> HardCase:
    """The learned scale is exp(90) before it is clamped; scores of cosine 0 must stay 0."""
    module = Projections(2, 2, 2, 0.0)
    with torch.no_grad():
        module.log_scale.fill_(90.0)
        naive = float(module.log_scale.exp() * torch.tensor(0.0))
        module.clamp_scale()
        ours = module.log_scale.exp().item()
    holds, text = abs(ours - 100) < 1e-3, f"scale {ours:.6g}"
    return HardCase(
        "InfoNCE", "log of the scale at 90", "scale 100", f"infinite: 0 x scale is {naive}", text, holds, naive == 0
    )


def _constant_map() -> HardCase:
    """A no-contact gel: the deviation over a constant map is 0, and its gradient must be 0."""
    return _case(
        "tower statistics",
        "deviation of a constant map",
        torch.full((1, 1, 2, 2), 0.5),
        lambda x: ((x - x.mean()) ** 2).mean().sqrt(),
        lambda x: stage_statistics([x])[0, 1],
        (0.0, [0.0] * 4),
    )


def _zero_embedding() -> HardCase:
    """A black picture may give a zero vector: its embedding and its gradient must be finite."""
    module = Projections(2, 2, 2, 0.0).eval()
    nn.init.zeros_(module.touch.bias)
    nn.init.eye_(module.touch.weight)
    zero = torch.zeros(1, 2)
    naive = _with_slope(lambda x: (x / (x * x).sum().sqrt())[0, 0], zero)
    ours = _with_slope(lambda x: module(x, module.touch)[0, 0], zero)
    finite = [all(map(math.isfinite, (value, *slope))) for value, slope in (naive, ours)]
    expected = "0, and a finite gradient"
    holds = finite[1] and ours[0] == 0
    return HardCase("cosine", "an embedding of zeros", expected, _text(*naive), _text(*ours), holds, finite[0])
