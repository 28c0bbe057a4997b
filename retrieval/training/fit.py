"""The training loop: everything that is learned by steps down a gradient is learned in it."""

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


@dataclass(frozen=True)
class Plan:
    """How long to train, and how fast.

    steps: how many steps the optimiser takes. learning_rate: of the first step; then it follows `schedule`
    (`retrieval.model.config.SCHEDULES`). validate_every: the module is validated after so many steps, and after the
    last.
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
    """Minimise the `loss` of batches, one a step; returns how many steps are done, fewer than planned once `should_stop()`.

    done: steps of an earlier run that this one goes on from; `batches` are those after them. Each step is taken within
    `step_context()`; before_step: called with the gradients in place; after_step: with the number of steps done; note: what
    the bar says behind the loss; validate: with the number of steps done, also when it is stopped. Raises
    NumericalError for a loss that is not finite, before anything has changed by it.
    """
    for batch in batches:
        for group in optimizer.param_groups:
            group["lr"] = plan.learning_rate * SCHEDULES[plan.schedule](done, plan.steps)
        with step_context():
            optimizer.zero_grad(set_to_none=True)
            current = loss(batch)
            value = current.item()
            if not math.isfinite(value):
                raise NumericalError(
                    f"the loss must stay finite; {bar.title}, step {done}, gave {value}; lower learning_rate, or where "
                    "there is none to set, report it"
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


@dataclass(frozen=True)
class BestStep:
    """The step after which a module was worth most on validation objects, and what it was worth."""

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
    """`fit` by AdamW, leaving `module` in evaluation mode as it was when `score()` was highest.

    loss: of the step with this number. Only matrices decay: a bias or a temperature has no reason to be small.
    """
    groups: list[dict[str, Any]] = [{"params": [], "weight_decay": 0.0}, {"params": [], "weight_decay": weight_decay}]
    for parameter in module.parameters():
        groups[parameter.ndim > 1]["params"].append(parameter)
    best, kept = BestStep(0, -math.inf), dict[str, Tensor]()

    def validate(done: int) -> None:
        nonlocal best, kept
        module.eval()
        with torch.inference_mode():
            value = score()
        module.train()
        if value > best.value:
            best = BestStep(done, value)
            kept = {name: tensor.clone() for name, tensor in module.state_dict().items()}

    def note() -> str:
        return f"  validation AUC {best.value:.3f}" if kept else ""

    optimizer, steps = torch.optim.AdamW(groups), range(plan.steps)
    module.train()
    fit(optimizer, plan, steps, loss, bar=bar, after_step=after_step, note=note, validate=validate)
    module.load_state_dict(kept)
    module.eval()
    return best
