"""Data-parallel training: the ranks share the encoding of a batch, and all compute the same loss.

Every rank knows the whole batch (the sampler is stateless), encodes its share of the distinct images, and gathers the
features of the others. The gather is differentiable, so the mean of the ranks' gradients equals the gradient of one
process; with negatives from the own rank alone it would differ by half. Started by `torchrun`; without it, one rank.
"""

import os
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn


def start() -> None:
    """Join the ranks that `torchrun` started, if it did."""
    if "RANK" not in os.environ or dist.is_initialized():
        return
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")


def stop() -> None:
    """Leave the ranks, if joined."""
    if dist.is_initialized():
        dist.destroy_process_group()


def rank() -> int:
    """Number of this process, 0 where there is one."""
    return dist.get_rank() if dist.is_initialized() else 0


def world_size() -> int:
    """Number of processes."""
    return dist.get_world_size() if dist.is_initialized() else 1


def share(count: int) -> list[int]:
    """Rows of a batch of `count` that this rank encodes: equally many on each rank, the last ones repeated."""
    size = -(-count // world_size())
    start_row = rank() * size
    return [min(row, count - 1) for row in range(start_row, start_row + size)]


def gather_rows(local: Tensor, count: int) -> Tensor:
    """All ranks' rows (count, d) from this rank's share (`share(count)`, d), with gradients to the other ranks."""
    if world_size() == 1:
        return local
    rows: Tensor = _Gather.apply(local)  # type: ignore[no-untyped-call]
    return rows[:count]


class _Gather(torch.autograd.Function):
    """All ranks' rows; backward, the sum over ranks of the gradients of this rank's own rows."""

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
    """Whether `flag` holds on any rank: one answer for all, and nobody gets it before everybody has asked."""
    if world_size() == 1:
        return flag
    count = torch.tensor(float(flag), device=device)
    dist.all_reduce(count)
    return bool(count.item() > 0)


def average_gradients(model: nn.Module) -> None:
    """Replace every gradient by its mean over the ranks."""
    if world_size() == 1:
        return
    for parameter in model.parameters():
        if parameter.requires_grad:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            dist.all_reduce(parameter.grad)
            parameter.grad /= world_size()


def average_buffers(model: nn.Module) -> None:
    """Replace every floating buffer (running batch statistics) by its mean, so that the ranks stay one model."""
    if world_size() == 1:
        return
    for buffer in model.buffers():
        if buffer.is_floating_point():
            dist.all_reduce(buffer)
            buffer /= world_size()
