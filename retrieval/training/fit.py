"""The training loop of everything that is trained by gradient descent."""

import math
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from retrieval.console.progress import Bar
from retrieval.errors import NumericalError
from retrieval.model.config import SCHEDULES

Batch = TypeVar("Batch")
RATE = "rate"
"""Key of a parameter group: the ratio of its learning rate to that of the plan; 1 without this key."""


@dataclass(frozen=True)
class Plan:
    """Length and learning rate of a training run.

    Attributes:
        steps: Number of optimiser steps.
        learning_rate: Learning rate of the first step.
        schedule: Name of the learning rate's schedule (`retrieval.model.config.SCHEDULES`).
        validate_every: Number of steps between validations; the last step is always followed by one.
    """

    steps: int
    learning_rate: float
    schedule: str = "cosine"
    validate_every: int = 1


def fit(
    optimizer: torch.optim.Optimizer,
    plan: Plan,
    batches: Iterable[Batch],
    loss: Callable[[Batch], Tensor],
    *,
    bar: Bar,
    done: int = 0,
    step_context: Callable[[], AbstractContextManager[Any]] = nullcontext,
    before_step: Callable[[], None] = lambda: None,
    after_step: Callable[[int], None] = lambda done: None,
    note: Callable[[], str] = lambda: "",
    validate: Callable[[int], None] = lambda done: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> int:
    """Minimise the loss of batches, one batch a step.

    Args:
        optimizer: The optimiser.
        plan: Length and learning rate of the training run.
        batches: The remaining batches.
        loss: Returns the loss of a batch.
        bar: Progress bar.
        done: Number of steps that an earlier run completed.
        step_context: Context of each step.
        before_step: Called when the gradients are computed.
        after_step: Called with the number of completed steps.
        note: Text after the loss in the progress bar.
        validate: Called with the number of completed steps, also on an early stop.
        should_stop: Called after each step.

    Returns:
        The number of completed steps: fewer than planned if `should_stop()` returned True.

    Raises:
        NumericalError: The loss is not finite; no parameter has changed in this step.
    """
    for batch in batches:
        for group in optimizer.param_groups:
            group["lr"] = plan.learning_rate * group.get(RATE, 1.0) * SCHEDULES[plan.schedule](done, plan.steps)
        with step_context():
            optimizer.zero_grad(set_to_none=True)
            current = loss(batch)
            value = current.item()
            if not math.isfinite(value):
                raise NumericalError(
                    f"the loss must stay finite; {bar.title}, step {done}, gave {value}; lower learning_rate, or "
                    "report this if there is no such setting"
                )
            current.backward()  # type: ignore[no-untyped-call]
            before_step()
            optimizer.step()
        done += 1
        after_step(done)
        bar.advance(note=f"loss {value:.3f}{note()}")
        stop = should_stop()
        if stop or done % plan.validate_every == 0 or done == plan.steps:
            validate(done)
        if stop:
            break
    return done


def freeze_batch_norm(module: nn.Module) -> None:
    """Put every batch normalisation of a module into evaluation mode: it uses its statistics and keeps them."""
    for part in module.modules():
        if isinstance(part, nn.BatchNorm2d):
            part.eval()


@dataclass(frozen=True)
class BestStep:
    """The step with the highest score on validation objects.

    Attributes:
        step: Number of completed steps.
        value: The score.
    """

    step: int
    value: float


def fit_best(
    module: nn.Module,
    plan: Plan,
    loss: Callable[[int], Tensor],
    score: Callable[[], float],
    *,
    bar: Bar,
    weight_decay: float = 0.0,
    after_step: Callable[[int], None] = lambda done: None,
) -> BestStep:
    """Train `module` by `fit` with AdamW, and restore the weights of its best step.

    `loss` takes the number of the step; `score` is the validation score, higher is better. Weight decay applies to
    matrices only, since biases and temperatures need not be small. The module ends in evaluation mode.
    """
    groups: list[dict[str, Any]] = [{"params": [], "weight_decay": 0.0}, {"params": [], "weight_decay": weight_decay}]
    for parameter in module.parameters():
        groups[parameter.ndim > 1]["params"].append(parameter)
    best, best_weights = BestStep(0, -math.inf), dict[str, Tensor]()

    def validate(done: int) -> None:
        nonlocal best, best_weights
        module.eval()
        with torch.inference_mode():
            value = score()
        module.train()
        if value > best.value:
            best = BestStep(done, value)
            best_weights = {name: tensor.clone() for name, tensor in module.state_dict().items()}

    def note() -> str:
        return f"  validation AUC {best.value:.3f}" if best_weights else ""

    optimizer, steps = torch.optim.AdamW(groups), range(plan.steps)
    module.train()
    fit(optimizer, plan, steps, loss, bar=bar, after_step=after_step, note=note, validate=validate)
    module.load_state_dict(best_weights)
    module.eval()
    return best
