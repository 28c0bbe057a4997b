"""The optimisation that the small learned methods share: AdamW, cosine schedule, the best step on validation."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retrieval.console.progress import Bar
from retrieval.errors import NumericalError
from retrieval.methods.standardise import Standardiser


@dataclass(frozen=True)
class Optimisation:
    """steps: optimiser steps; every `judge_every` of them and after the last the module is judged."""

    steps: int
    judge_every: int
    learning_rate: float
    weight_decay: float = 0.0

    def rate(self, step: int) -> float:
        """Learning rate of a step (from 1): half a cosine from the first to 0 after the last."""
        return 0.5 * self.learning_rate * (1 + math.cos(math.pi * (step - 1) / self.steps))


@dataclass(frozen=True)
class Best:
    """The step after which the module was worth most, and what it was worth."""

    step: int
    value: float


@contextmanager
def seeded(seed: int) -> Iterator[torch.Generator]:
    """A generator for what is drawn, and torch's own stream (first weights, dropout) seeded, its state put back."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield torch.Generator().manual_seed(seed)


def optimise(
    module: nn.Module,
    plan: Optimisation,
    loss: Callable[[], Tensor],
    value: Callable[[], float],
    *,
    bar: Bar,
    after_step: Callable[[], None] = lambda: None,
) -> Best:
    """Minimise `loss()` and leave `module` in evaluation mode as it was when `value()` was highest.

    Raises NumericalError for a loss that is not finite.
    """
    optimizer = _optimizer(module, plan.weight_decay)
    best, kept = Best(0, -math.inf), dict[str, Tensor]()
    for step in range(1, plan.steps + 1):
        module.train()
        _descend(optimizer, loss, plan.rate(step))
        after_step()
        bar.advance(note=f"validation AUC {best.value:.3f}" if kept else "")
        if step % plan.judge_every == 0 or step == plan.steps:
            worth = _judged(module, value)
            if worth > best.value:
                best = Best(step, worth)
                kept = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    module.load_state_dict(kept)
    module.eval()
    return best


def _optimizer(module: nn.Module, weight_decay: float) -> torch.optim.Optimizer:
    """Only matrices decay: a bias or a temperature has no reason to be small."""
    groups: list[dict[str, Any]] = [{"params": [], "weight_decay": 0.0}, {"params": [], "weight_decay": weight_decay}]
    for parameter in module.parameters():
        groups[parameter.ndim > 1]["params"].append(parameter)
    return torch.optim.AdamW(groups)


def _descend(optimizer: torch.optim.Optimizer, loss: Callable[[], Tensor], rate: float) -> None:
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.zero_grad(set_to_none=True)
    current = loss()
    if not math.isfinite(current.item()):
        raise NumericalError(f"the loss must stay finite; got {current.item()}; lower the learning rate")
    current.backward()  # type: ignore[no-untyped-call]
    optimizer.step()


@torch.inference_mode()
def _judged(module: nn.Module, value: Callable[[], float]) -> float:
    module.eval()
    return value()


def standardised(standardise: Standardiser, x: NDArray[Any]) -> Tensor:
    """Standardised features (n, F'), a float32 tensor."""
    return torch.from_numpy(standardise(x)).float()


class ObjectDraws:
    """Draws of grasps by object, without a loop over items. owner (n,): object of each row, from 0."""

    def __init__(self, owner: Tensor, generator: torch.Generator) -> None:
        self._rows = torch.argsort(owner, stable=True)
        self._counts = torch.bincount(owner)
        self._starts = self._counts.cumsum(0) - self._counts
        self._generator = generator
        self.objects = len(self._counts)

    def distinct_objects(self, count: int) -> Tensor:
        """(count,) objects, each at most once."""
        return torch.randperm(self.objects, generator=self._generator)[:count]

    def other_objects(self, objects: Tensor, each: int) -> Tensor:
        """(B, each) for each of `objects` (B,) so many others, uniformly, with replacement."""
        drawn = torch.randint(self.objects - 1, (len(objects), each), generator=self._generator)
        return drawn + (drawn >= objects[:, None])

    def rows(self, objects: Tensor) -> Tensor:
        """One row of each of `objects` (any shape), uniformly."""
        drawn = torch.rand(objects.shape, generator=self._generator, dtype=torch.float64)
        return self._rows[self._starts[objects] + (drawn * self._counts[objects]).long()]

    def sets(self, objects: Tensor, most: int) -> tuple[Tensor, Tensor]:
        """Sets of 1..most distinct rows of each of `objects` (B,): (B, most) rows and (B, most) which of them count.

        A set's size is uniform, but no larger than its object's number of rows.
        """
        counts = self._counts[objects]
        order = torch.rand(len(objects), max(int(counts.max()), most), generator=self._generator)
        order[torch.arange(order.shape[1]) >= counts[:, None]] = torch.inf
        places = order.argsort(1)[:, :most]
        sizes = torch.randint(1, most + 1, (len(objects),), generator=self._generator).minimum(counts)
        held = torch.arange(most) < sizes[:, None]
        return self._rows[self._starts[objects][:, None] + places.where(held, 0)], held
