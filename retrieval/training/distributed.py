"""Data-parallel training: the ranks share the encoding of a batch, and all compute the same loss.

Every rank knows the whole batch (the sampler is stateless), encodes its share of the distinct images, and gathers the
features of the others. The gather is differentiable, and batch normalisation in the towers takes its statistics over
all ranks' images, so the loss, the running statistics and the mean of the ranks' gradients equal those of one process
to rounding. With negatives from the own rank alone the gradient would differ by half; with batch statistics of the own
rank alone, a ResNet-18's differed by 115 % and its loss was another. What differs is dropout INSIDE a tower (the
1000-way output of MobileNetV2): each rank draws the mask of its own images. Started by `torchrun`; without it, one
rank.

PyTorch's SyncBatchNorm would not do: it refuses a CPU, and counts the images that fill up a share as if they were new.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn import functional


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


def rank_rows(count: int) -> list[int]:
    """Rows of a batch of `count` that this rank encodes: equally many on each rank, the last ones repeated."""
    size = -(-count // world_size())
    start_row = rank() * size
    return [min(row, count - 1) for row in range(start_row, start_row + size)]


def gather_rows(local: Tensor, count: int) -> Tensor:
    """All ranks' rows (count, d) from this rank's share (`rank_rows(count)`, d), with gradients to the other ranks."""
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


# Batch normalisation -------------------------------------------------------------------------------------

_counted_fraction: ContextVar[float] = ContextVar("_counted", default=1.0)
"""Which part of the rows at hand, from the first on, are of the batch; the others fill up a share."""


@contextmanager
def counting_rank_rows(count: int) -> Iterator[None]:
    """While this rank passes its share (`rank_rows(count)`) through a tower: what fills it up counts in no statistics."""
    size = len(rank_rows(count))
    token = _counted_fraction.set(min(max(count - rank() * size, 0), size) / size)
    try:
        yield
    finally:
        _counted_fraction.reset(token)


def synchronize_batch_norm(tower: nn.Module) -> None:
    """Make the batch normalisations of a tower take their statistics over the images of all ranks."""
    if world_size() == 1:
        return
    for module in tower.modules():
        if type(module) is nn.BatchNorm2d:
            module.__class__ = SharedBatchNorm  # the same weights under the same names; only training differs


class SharedBatchNorm(nn.BatchNorm2d):
    """Batch normalisation (B, C, H, W) whose training statistics are those of all ranks' images; see `counting_rank_rows`."""

    def forward(self, x: Tensor) -> Tensor:
        """As BatchNorm2d. In training every rank must call it, for the ranks wait for each other."""
        if not self.training:
            return super().forward(x)
        rows = round(_counted_fraction.get() * len(x))
        # Half precision would lose the small ones among many; BatchNorm2d too takes its sums in float32 then.
        wide = x.to(torch.promote_types(x.dtype, torch.float32))
        mean, variance, count = _statistics(wide.detach()[:rows])
        self._update_running_statistics(mean, variance * count / (count - 1))
        made: Tensor = _Normalise.apply(  # type: ignore[no-untyped-call]
            wide, self.weight, self.bias, mean, variance, count, rows, self.eps
        )
        return made.to(x.dtype)

    @torch.no_grad()
    def _update_running_statistics(self, mean: Tensor, variance: Tensor) -> None:
        """Take the batch into the running statistics."""
        assert self.running_mean is not None  # towers keep PyTorch's defaults
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        self.num_batches_tracked.add_(1)
        self.running_mean.lerp_(mean, self.momentum)
        self.running_var.lerp_(variance, self.momentum)


def _statistics(counted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and variance (C,) and count () of the rows (B, C, H, W) of all ranks; a rank may have none."""
    count = counted.new_full((counted.shape[1],), counted.numel() / counted.shape[1])
    mean, variance = torch.zeros_like(count), torch.zeros_like(count)
    if len(counted):  # the kernel of BatchNorm2d; `var_mean` takes thirty times as long where channels are last
        mean, variance = torch.batch_norm_update_stats(counted, None, None, 0.0)
    own = torch.stack([count, mean, variance])
    parts = [torch.empty_like(own) for _ in range(world_size())]
    dist.all_gather(parts, own)
    counts, means, variances = torch.stack(parts, 1)
    shares = counts / counts.sum(0)
    whole = (shares * means).sum(0)
    # Of the differences: the mean square less the squared mean loses all digits where the mean is far from 0.
    return whole, (shares * (variances + (means - whole).square())).sum(0), counts.sum(0)[0]


class _Normalise(torch.autograd.Function):
    """x (B, C, H, W) less `mean` over its standard deviation, by weight and bias, all (C,): statistics of `count`
    numbers a channel, which are those of the first `rows` rows of every rank. PyTorch's own kernels do it, in a third
    of the passes over x that plain operations take.
    """

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        weight: Tensor,
        bias: Tensor,
        mean: Tensor,
        variance: Tensor,
        count: Tensor,
        rows: int,
        eps: float,
    ) -> Tensor:
        ctx.save_for_backward(x, weight, mean, variance, count)
        ctx.rows, ctx.eps = rows, eps
        return functional.batch_norm(x, mean, variance, weight, bias, eps=eps)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Rows that only fill up a share are in no loss: their gradient is zero, and stays zero."""
        x, weight, mean, variance, count = ctx.saved_tensors
        own, seen = gradient[: ctx.rows], x[: ctx.rows]
        scale, along, total = torch.rsqrt(variance + ctx.eps), torch.zeros_like(mean), torch.zeros_like(mean)
        if len(own):
            _, along, total = torch.ops.aten.native_batch_norm_backward(
                own, seen, None, None, None, mean, scale, True, ctx.eps, [False, True, True]
            )
        sums = torch.stack([total, along])
        dist.all_reduce(sums)
        shift, slope = sums / count
        by = (weight * scale)[:, None, None]
        normal = functional.batch_norm(seen, mean, variance, eps=ctx.eps)
        moved = torch.zeros_like(gradient)
        flat = torch.addcmul(-by * shift[:, None, None], normal, -by * slope[:, None, None])
        torch.addcmul(flat, own, by, out=moved[: ctx.rows])
        return moved, along, total, None, None, None, None, None
