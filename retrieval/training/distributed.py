"""Data-parallel training: each rank encodes a part of a batch, and all ranks compute the same loss.

Every rank has the whole batch (the sampler is stateless), encodes its rows of the distinct images, and gathers the
features of the other ranks. The gather is differentiable, so the loss and the mean of the ranks' gradients equal those
of one process up to rounding. (With negatives from one rank only, the gradient would differ by half.) `torchrun` starts
the ranks; without it there is one rank.
"""

import os
import warnings
from collections.abc import Callable
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from retrieval.errors import ConfigError


def start() -> None:
    """Join the process group if `torchrun` started this process."""
    if "RANK" not in os.environ or dist.is_initialized():
        return
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")


def stop() -> None:
    """Leave the process group, if joined."""
    if dist.is_initialized():
        dist.destroy_process_group()


def rank() -> int:
    """Return the number of this process; 0 without a process group."""
    return dist.get_rank() if dist.is_initialized() else 0


def world_size() -> int:
    """Return the number of processes."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank_rows(count: int) -> list[int]:
    """Return the rows of a batch of `count` that this rank encodes: equally many on each rank, padded by the last."""
    size = -(-count // world_size())
    return [min(rank() * size + row, count - 1) for row in range(size)]


def gather_rows(local: Tensor, count: int) -> Tensor:
    """Return all ranks' rows (count, d), with gradients to the other ranks, given those of `rank_rows(count)`."""
    if world_size() == 1:
        return local
    rows: Tensor = _Gather.apply(local)  # type: ignore[no-untyped-call]
    return rows[:count]


class _Gather(torch.autograd.Function):
    """Gather of all ranks' rows; backward sums the gradients of this rank's rows over the ranks."""

    @staticmethod
    def forward(ctx: Any, local: Tensor) -> Tensor:
        parts = [torch.empty_like(local, memory_format=torch.contiguous_format) for _ in range(world_size())]
        dist.all_gather(parts, local.contiguous())
        return torch.cat(parts)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        total = gradient.clone(memory_format=torch.contiguous_format)
        dist.all_reduce(total)
        return total.chunk(world_size())[rank()]


def any_rank(flag: bool, device: torch.device) -> bool:
    """Return whether `flag` is True on any rank; all ranks must call this, and they wait for each other."""
    if world_size() == 1:
        return flag
    count = torch.tensor(float(flag), device=device)
    dist.all_reduce(count)
    return bool(count.item() > 0)


def synchronise_batch_norm(tower: nn.Module, device: torch.device) -> None:
    """Make the batch normalisation of a tower, in its training mode, use the statistics of all ranks' images.

    Raises:
        ConfigError: PyTorch has no such layer for CPUs, where each rank would use the statistics of its own images.
    """
    layers = (module for module in tower.modules() if isinstance(module, nn.BatchNorm2d))
    if world_size() == 1 or not any(layer.training for layer in layers):
        return
    if device.type == "cpu":
        raise ConfigError(
            f"{world_size()} ranks on CPUs cannot share the statistics of batch normalisation; set "
            "freeze_batch_norm = true or freeze_towers = true, train in one process, or use GPUs"
        )
    nn.SyncBatchNorm.convert_sync_batchnorm(tower)  # type: ignore[no-untyped-call]


class _Loss(nn.Module):
    """A loss as a module that holds the trained parameters, as PyTorch's data parallelism requires."""

    def __init__(self, modules: nn.Module, loss: Callable[..., Tensor]) -> None:
        super().__init__()
        self.modules_of_loss, self.loss = modules, loss

    def forward(self, *arguments: Any) -> Tensor:
        return self.loss(*arguments)


def averaging_gradients(modules: nn.Module, loss: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Return the loss such that its `backward` averages the gradients of `modules` over the ranks."""
    if world_size() == 1:
        return loss
    # Gradients of 1 x 1 and depthwise convolutions have strides of axes of length 1 that differ from the weights'.
    warnings.filterwarnings("ignore", "Grad strides do not match bucket view strides")
    return DistributedDataParallel(_Loss(modules, loss), static_graph=True)  # some weights may be in no loss
