"""The state of an unfinished training run, next to its output: weights, optimiser, step, and fixed settings."""

import hashlib
import inspect
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from retrieval.errors import CheckpointError
from retrieval.model.checkpoint import (
    Checkpoint,
    load_checkpoint,
    load_weights,
    read_tensors,
    sibling_file,
    write_tensors,
)

if TYPE_CHECKING:
    from retrieval.training.train import Trainer


_MODEL, _OPTIMIZER = "model.", "optimizer."


def state_path(out: Path) -> Path:
    """Return the file of an unfinished training run of `out`."""
    return sibling_file(out, ".state.safetensors")


def require_no_unfinished_state(out: Path) -> None:
    """Check that a new training run of `out` overwrites no unfinished one.

    Raises:
        CheckpointError: The state of an unfinished training run exists.
    """
    if state_path(out).exists():
        raise CheckpointError(
            f"an unfinished training run is at {state_path(out)}; continue it with --resume, or delete the file to "
            "start a new one"
        )


def save_state(out: Path, modules: nn.ModuleDict, optimizer: torch.optim.Optimizer, header: Mapping[str, Any]) -> None:
    """Write the state of an unfinished training run of `out`: all modules, their optimiser, and a header of JSON types.

    The header holds the step and the settings that `load_state` compares.
    """
    tensors = {f"{_MODEL}{name}": tensor for name, tensor in modules.state_dict().items()}
    for name, parameter in modules.named_parameters():
        for quantity, tensor in optimizer.state.get(parameter, {}).items():
            tensors[f"{_OPTIMIZER}{name}.{quantity}"] = tensor
    write_tensors(state_path(out), tensors, header)


def load_state(
    out: Path, modules: nn.ModuleDict, optimizer: torch.optim.Optimizer, identity: Mapping[str, Any]
) -> dict[str, Any]:
    """Load the state that `save_state` wrote into `modules` and `optimizer`, and return its header.

    Raises:
        CheckpointError: There is no state, or its header differs from `identity`: it belongs to another training run.
    """
    path = state_path(out)
    tensors, header = read_tensors(path)
    for name, value in json.loads(json.dumps(identity)).items():
        if header.get(name) != value:
            raise CheckpointError(
                f"{path} belongs to a training run with another {name.replace('_', ' ')}; resume with the same data "
                "and configuration, or delete the file to start a new one"
            )
    load_weights(
        modules, {name.removeprefix(_MODEL): tensor for name, tensor in tensors.items() if name.startswith(_MODEL)}
    )
    for name, parameter in modules.named_parameters():
        prefix = f"{_OPTIMIZER}{name}."
        stored = {key.removeprefix(prefix): tensor for key, tensor in tensors.items() if key.startswith(prefix)}
        if stored:  # PyTorch keeps the step count on the CPU
            optimizer.state[parameter] = {
                quantity: tensor if quantity == "step" else tensor.to(parameter.device)
                for quantity, tensor in stored.items()
            }
    return header


def code_digest(*classes: type) -> dict[str, str]:
    """Return {"code": SHA-256} of the source of classes outside this project, or {} without any.

    So an edited loss or method is fitted again. The source is that of the module, or of the class for a notebook.
    """
    sources = []
    for each in classes:
        if not each.__module__.startswith("retrieval."):
            module = sys.modules[each.__module__]
            try:
                sources.append(inspect.getsource(module if getattr(module, "__file__", None) else each))
            except (OSError, TypeError):  # typed into an interpreter, without source
                sources.append(each.__qualname__)
    return {"code": hashlib.sha256("\n".join(sources).encode()).hexdigest()} if sources else {}


def unfinished_path(done: Path) -> Path:
    """Return the path of a checkpoint during its training, in another folder, so that `done` is always complete."""
    return done.parent / "unfinished" / done.name


def finish_training(trainer: "Trainer", done: Path, quiet: bool) -> Checkpoint:
    """Train to the end and return the checkpoint; read a finished training, and resume an unfinished one.

    The trainer's `out` is `unfinished_path(done)`. A checkpoint of another training run at `done` is replaced.

    Raises:
        JobInterrupted: After Ctrl-C; the next call resumes.
    """
    mine = (trainer.config, trainer.split, trainer.data_digest, trainer.code.get("code"))
    if done.is_file():
        stored = load_checkpoint(done)
        if (stored.config, stored.split, *map(stored.provenance.get, ("data_digest", "code"))) == mine:
            return stored
    if state_path(trainer.out).is_file():
        try:
            trainer.resume()
        except CheckpointError:  # of another training run
            state_path(trainer.out).unlink()
    trainer.run(quiet)
    for ending in (".md", ".safetensors"):
        sibling_file(trainer.out, ending).replace(sibling_file(done, ending))
    return load_checkpoint(done)
