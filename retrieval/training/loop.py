"""The training loop of everything that is trained by gradient descent, and its state file.

A step depends only on its number, the seed and the state. So a run that is stopped and continued on the same machine
gives the same bits as an uninterrupted run.
"""

import json
import math
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from retrieval.console.interruption import interruption
from retrieval.console.progress import Bar
from retrieval.errors import CheckpointError, JobInterrupted, NumericalError
from retrieval.model.checkpoint import load_weights, read_tensors, sibling_file, write_tensors
from retrieval.model.config import SCHEDULES

Batch = TypeVar("Batch")
OnStep = Callable[[int, dict[str, float]], object]
"""Called after each step with the number of completed steps, and `loss`, `learning_rate` and the metrics of a
validation after this step; with 0 and the metrics alone before the first step. Its result is ignored."""
RATE = "rate"
"""Key of a parameter group: the ratio of its learning rate to that of the plan; 1 without this key."""
_MODULE, _OPTIMIZER, _BEST = "module.", "optimizer.", "best."


@dataclass(frozen=True)
class Plan:
    """Length and learning rate of a training run.

    Attributes:
        steps: Number of optimiser steps.
        learning_rate: Learning rate of the first step.
        schedule: Name of the learning rate's schedule (`retrieval.model.config.SCHEDULES`).
        validate_every: Number of steps between two validations, and between two states; the last step has both.
    """

    steps: int
    learning_rate: float
    schedule: str = "cosine"
    validate_every: int = 1


@dataclass(frozen=True)
class BestStep:
    """The step whose weights a training run returns, as the number of completed steps.

    `metrics` is the result of its validation; the first value is the score, higher is better. Without validation they
    are empty, and the last step is the best one.
    """

    step: int = 0
    metrics: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class StateFile:
    """The file of an unfinished run (`state_path`): all weights, those of the best step, the optimiser, and the step.

    `identity` is all that determines the run, in JSON types. The state of a run with another identity cannot be
    continued; it is replaced if it `is_replaceable`.
    """

    path: Path
    identity: Mapping[str, Any]
    is_replaceable: bool = False


def state_path(out: Path) -> Path:
    """Return the file of an unfinished training run of the checkpoint `out`."""
    return sibling_file(out, ".state.safetensors")


def train_loop(
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    plan: Plan,
    batches: Callable[[range], Iterable[Batch]],
    loss: Callable[[int, Batch], Tensor],
    *,
    title: str,
    validate: Callable[[], dict[str, float]] | None = None,
    state: StateFile | None = None,
    step_context: Callable[[], AbstractContextManager[Any]] = nullcontext,
    on_step: OnStep | None = None,
) -> BestStep:
    """Minimise the loss of batches, one batch a step, and leave the weights of the best step in `module`.

    The weights before the first step are validated, too: a run that starts from good weights never makes them worse.

    With a state file the run continues from it, and the first Ctrl-C ends the run after the current step.

    Args:
        module: All that is trained.
        optimizer: The optimiser of its parameters.
        plan: Length and learning rate of the run.
        batches: Returns the batches of steps.
        loss: Returns the loss (scalar) of a step, given its number from 0 and its batch.
        title: What the progress bar shows.
        validate: Returns the metrics of `BestStep`, and leaves the module in training mode.
        state: Where an unfinished run is stored; None for a short run.
        step_context: Context of each step.
        on_step: Called with number and values of each step, and before the first one with its validation.

    Raises:
        NumericalError: The loss is not finite; no parameter has changed in this step.
        CheckpointError: The state file is damaged or belongs to another run.
        JobInterrupted: After Ctrl-C; the state is stored.
    """
    done, best, best_weights = 0, BestStep(), dict[str, Tensor]()
    if state and state.path.exists():
        with suppress(CheckpointError) if state.is_replaceable else nullcontext():
            done, best, best_weights = _load(state, module, optimizer)
    tell: OnStep = on_step or (lambda *_: None)
    with (
        interruption() if state else nullcontext(threading.Event()) as stop,
        Bar(title, plan.steps, "steps", done=done) as bar,
    ):
        if validate and not done and (metrics := validate()):
            best, best_weights = BestStep(0, metrics), _copied(module)
            tell(0, metrics)
        for batch in batches(range(done, plan.steps)):
            rate = plan.learning_rate * SCHEDULES[plan.schedule](done, plan.steps)
            for group in optimizer.param_groups:
                group["lr"] = rate * group.get(RATE, 1.0)
            with step_context():
                optimizer.zero_grad(set_to_none=True)
                current = loss(done, batch)
                value = current.item()
                if not math.isfinite(value):
                    raise NumericalError(
                        f"the loss must stay finite; {title}, step {done}, gave {value}; lower learning_rate, or "
                        "report this if there is no such setting"
                    )
                current.backward()  # type: ignore[no-untyped-call]
                optimizer.step()
            done += 1
            scores = [f"  best {name.replace('_', ' ')} {score:.3f}" for name, score in best.metrics.items()]
            bar.advance(note="".join([f"loss {value:.3f}", *scores[:1]]))
            is_due = done % plan.validate_every == 0 or done == plan.steps
            values = {"loss": value, "learning_rate": rate}
            if is_due:
                reached = BestStep(done, validate() if validate else {})
                values |= reached.metrics
                if not reached.metrics:
                    best = reached
                elif not best.metrics or next(iter(reached.metrics.values())) > next(iter(best.metrics.values())):
                    best, best_weights = reached, _copied(module)
            tell(done, values)
            is_stopped = stop.is_set()
            if state and (is_due or is_stopped):
                _save(state, module, optimizer, done, best, best_weights)
                if is_stopped:
                    raise JobInterrupted(
                        f"Stopped at step {done} of {plan.steps}. The state is stored in {state.path}; run the same "
                        "command to continue."
                    )
    if best_weights:
        module.load_state_dict(best_weights)
    return best


def _copied(module: nn.Module) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def freeze_batch_norm(module: nn.Module) -> None:
    """Put every batch normalisation of a module into evaluation mode: it uses its statistics and keeps them."""
    for part in module.modules():
        if isinstance(part, nn.BatchNorm2d):
            part.eval()


# The state -------------------------------------------------------------------------------------------------


def _save(
    state: StateFile,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    done: int,
    best: BestStep,
    best_weights: Mapping[str, Tensor],
) -> None:
    tensors = {f"{_MODULE}{name}": tensor for name, tensor in module.state_dict().items()}
    tensors |= {f"{_BEST}{name}": tensor for name, tensor in best_weights.items()}
    tensors |= {
        f"{_OPTIMIZER}{name}.{quantity}": tensor
        for name, parameter in module.named_parameters()
        for quantity, tensor in optimizer.state.get(parameter, {}).items()
    }
    header = {"step": done, "best_step": best.step, "metrics": best.metrics, "identity": state.identity}
    write_tensors(state.path, tensors, header)


def _load(
    state: StateFile, module: nn.Module, optimizer: torch.optim.Optimizer
) -> tuple[int, BestStep, dict[str, Tensor]]:
    """Load a state into `module` and `optimizer`; return the completed steps, the best one, and its weights."""
    tensors, header = read_tensors(state.path)
    stored = header["identity"]
    for name, value in json.loads(json.dumps(state.identity)).items():
        if stored.get(name) != value:
            raise CheckpointError(
                f"{state.path} belongs to an unfinished training run with another {name.replace('_', ' ')}; repeat the "
                "command of that run to continue it, or delete the file to start a new one"
            )

    def part(prefix: str) -> dict[str, Tensor]:
        return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}

    load_weights(module, part(_MODULE))
    for name, parameter in module.named_parameters():
        if quantities := part(f"{_OPTIMIZER}{name}."):  # PyTorch keeps the step count on the CPU
            optimizer.state[parameter] = {
                quantity: tensor if quantity == "step" else tensor.to(parameter.device)
                for quantity, tensor in quantities.items()
            }
    return header["step"], BestStep(header["best_step"], header["metrics"]), part(_BEST)
