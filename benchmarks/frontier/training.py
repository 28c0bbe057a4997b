"""Number formats of the towers in training: rotation of the gradient of a step, and the time of the step."""

import copy
import dataclasses
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor, nn

from retrieval.data.pairs import PairBatch, PairSampler
from retrieval.frontier.clock import time_points
from retrieval.frontier.points import ApproximationResult, Panel, Tradeoff
from retrieval.frontier.sample import Sample
from retrieval.model.encode import autocast, has_fast_bfloat16, to_batch, touch_batch
from retrieval.model.fusion import Matcher
from retrieval.training.batches import BatchImages
from retrieval.training.trainer import WeightedLosses, batch_loss, set_training_mode

TOLERANCE = 0.1
"""Tolerance of 1 - cosine: a tenth of the value for two batches, whose gradients have little in common."""
_CPU = torch.device("cpu")


def training_formats(sample: Sample) -> ApproximationResult:
    """Compare float32 with bfloat16, if the processor supports it, at the model's weights."""
    step, other = (_Step(sample, 2 if sample.scale.quick else 4, number) for number in range(2))
    fast = has_fast_bfloat16(_CPU)
    points, works = zip(*_formats(sample, step, fast), strict=True)
    gradients = [work() for work in works]
    errors = [0.0, *(1 - _cosine(gradient, gradients[0]) for gradient in gradients[1:])]
    timed = time_points(
        [dataclasses.replace(point, error=error) for point, error in zip(points, errors, strict=True)],
        works,
        sample.scale.repeats,
    )
    between = _cosine(other(_trained(sample, step), "float32"), gradients[0])
    time = f"a step of {len(step.touches)} touches and {len(step.photos)} photos, forward and back, one thread"
    return ApproximationResult(
        "Number format of training",
        "The gradient of all weights by one batch, at the model's own weights, compared with that in float32. Those of "
        f"two batches have a cosine of {between:.2f} with each other. Gel images differ by a few grey levels, which "
        "bfloat16 rounds away, so training computes the first layers of some towers in float32."
        + ("" if fast else " Left out here: this processor multiplies no bfloat16, and trains in float32."),
        (Panel("rotation of the gradient", time, "1 - cosine", "float32", TOLERANCE, timed),),
    )


class _Step:
    """A prepared batch; calling it with a matcher returns the gradient of all weights, (weights,)."""

    def __init__(self, sample: Sample, touches: int, number: int) -> None:
        config = sample.checkpoint.config
        images = BatchImages(config.preprocessing)
        self.settings = dataclasses.replace(config.training, freeze_towers=False)
        self.batch: PairBatch = PairSampler(sample.grasps, seed=0, share_photos=True).batch(number, touches)
        self.touches = touch_batch([images.touch(grasp) for grasp in self.batch.grasps])
        self.photos = to_batch([config.preprocessing.load_photo(path) for path in self.batch.photos])

    def __call__(self, matcher: Matcher, precision: str) -> Tensor:
        torch.manual_seed(0)  # the dropout mask
        matcher.zero_grad(set_to_none=True)
        with autocast(_CPU, precision):
            features = matcher.touch_features(self.touches), matcher.photo_features(self.photos)
        batch_loss(
            matcher, WeightedLosses(self.settings.weights, matcher, len(self.batch.grasps)), self.batch, *features
        ).backward()  # type: ignore[no-untyped-call]
        grads = [weight.grad for weight in matcher.parameters() if weight.grad is not None]
        return torch.cat([grad.flatten() for grad in grads])


def _formats(sample: Sample, step: _Step, fast: bool) -> Iterator[tuple[Tradeoff, Callable[[], Tensor]]]:
    """Yield (a point without its error, its step): float32 first."""
    matcher = _trained(sample, step)
    rounds = fast and step.settings.precision != "float32"
    yield Tradeoff("float32", "", 0.0, is_default=not rounds), partial(step, matcher, "float32")
    if fast:
        point = Tradeoff("bfloat16", "first layers in float32", 0.0, is_default=rounds)
        yield point, partial(step, matcher, "bfloat16")
        yield Tradeoff("bfloat16", "all layers", 0.0), partial(step, _all_in_bfloat16(matcher), "bfloat16")


def _trained(sample: Sample, step: _Step) -> Matcher:
    """Return a copy of the model in training mode."""
    matcher = copy.deepcopy(sample.checkpoint.matcher).requires_grad_(True)
    set_training_mode(matcher, step.settings)
    return matcher


class _RoundedLinear(nn.Module):
    """A layer in bfloat16."""

    def __init__(self, layer: nn.Module) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            y: Tensor = self.layer(x)
        return y


def _all_in_bfloat16(matcher: Matcher) -> Matcher:
    """Return a copy whose towers compute all convolutions in bfloat16."""
    copied = copy.deepcopy(matcher)
    for tower in (copied.touch_tower, copied.photo_tower):
        for module in list(tower.modules()):
            for name, child in list(module.named_children()):
                if isinstance(child, nn.Conv2d):
                    setattr(module, name, _RoundedLinear(child))
    return copied


def _cosine(one: Tensor, other: Tensor) -> float:
    return float(torch.nn.functional.cosine_similarity(one.double(), other.double(), dim=0))
