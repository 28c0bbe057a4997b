"""Data-parallel training: each rank encodes a part of a batch, and all ranks compute the same loss.

Every rank has the whole batch (the sampler is stateless), encodes its rows of the distinct images, and gathers the
features of the other ranks. The gather is differentiable, and batch normalisation in the towers uses the statistics of
all ranks' images. So the loss, the running statistics and the mean of the ranks' gradients equal those of one process
up to rounding. With negatives from one rank only, the gradient would differ by half; with batch statistics of one rank
only, a ResNet-18's gradient differed by 115 %, and its loss differed too. One difference remains: dropout INSIDE a
tower (the 1000-way output of MobileNetV2), where each rank draws the mask of its own images. `torchrun` starts the
ranks; without it there is one rank.

PyTorch's SyncBatchNorm is not sufficient: it does not run on a CPU, and it counts repeated padding rows as new images.
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
    """Return the rows of a batch of `count` that this rank encodes.

    Every rank gets the same number of rows; the last row of the batch is repeated as padding.
    """
    size = -(-count // world_size())
    start_row = rank() * size
    return [min(row, count - 1) for row in range(start_row, start_row + size)]


def gather_rows(local: Tensor, count: int) -> Tensor:
    """Gather all ranks' rows (count, d), with gradients to the other ranks.

    Args:
        local: Values (len(rank_rows(count)), d) of this rank's rows.
        count: Number of rows in the batch.
    """
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
"""Fraction of the current rows, from the first on, that belong to the batch; the others are padding."""


@contextmanager
def counting_rank_rows(count: int) -> Iterator[None]:
    """Exclude padding rows from batch statistics while this rank encodes `rank_rows(count)`."""
    size = len(rank_rows(count))
    token = _counted_fraction.set(min(max(count - rank() * size, 0), size) / size)
    try:
        yield
    finally:
        _counted_fraction.reset(token)


def synchronize_batch_norm(tower: nn.Module) -> None:
    """Make the batch normalisation of a tower use the statistics of all ranks' images."""
    if world_size() == 1:
        return
    for module in tower.modules():
        if type(module) is nn.BatchNorm2d:
            module.__class__ = SharedBatchNorm  # keeps the weights and their names


class SharedBatchNorm(nn.BatchNorm2d):
    """Batch normalisation (B, C, H, W) with training statistics of all ranks' images, without padding rows."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalise like BatchNorm2d. In training all ranks must call it, since they wait for each other."""
        if not self.training:
            return super().forward(x)
        rows = round(_counted_fraction.get() * len(x))
        # Sums in half precision would lose small values; BatchNorm2d also uses float32 for them.
        wide = x.to(torch.promote_types(x.dtype, torch.float32))
        mean, variance, count = _statistics(wide.detach()[:rows])
        self._update_running_statistics(mean, variance * count / (count - 1))
        normalised: Tensor = _Normalise.apply(  # type: ignore[no-untyped-call]
            wide, self.weight, self.bias, mean, variance, count, rows, self.eps
        )
        return normalised.to(x.dtype)

    @torch.no_grad()
    def _update_running_statistics(self, mean: Tensor, variance: Tensor) -> None:
        """Update the running statistics with a batch."""
        assert self.running_mean is not None  # towers keep PyTorch's defaults
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        self.num_batches_tracked.add_(1)
        self.running_mean.lerp_(mean, self.momentum)
        self.running_var.lerp_(variance, self.momentum)


def _statistics(counted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean and variance (C,) and count () over the rows (B, C, H, W) of all ranks; a rank may have none."""
    count = counted.new_full((counted.shape[1],), counted.numel() / counted.shape[1])
    mean, variance = torch.zeros_like(count), torch.zeros_like(count)
    if len(counted):  # the kernel of BatchNorm2d; `var_mean` takes thirty times as long with channels last
        mean, variance = torch.batch_norm_update_stats(counted, None, None, 0.0)
    own = torch.stack([count, mean, variance])
    parts = [torch.empty_like(own) for _ in range(world_size())]
    dist.all_gather(parts, own)
    counts, means, variances = torch.stack(parts, 1)
    weights = counts / counts.sum(0)
    total_mean = (weights * means).sum(0)
    # Squared differences: the mean square minus the squared mean loses all digits if the mean is far from 0.
    return total_mean, (weights * (variances + (means - total_mean).square())).sum(0), counts.sum(0)[0]


class _Normalise(torch.autograd.Function):
    """Normalisation of x (B, C, H, W) by mean, variance, weight and bias, all (C,).

    The statistics are those of `count` values in each channel: the first `rows` rows of every rank. PyTorch's kernels
    need a third of the passes over x that plain operations take.
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
        """Return the gradients; padding rows are in no loss, so their gradient is zero."""
        x, weight, mean, variance, count = ctx.saved_tensors
        own, counted = gradient[: ctx.rows], x[: ctx.rows]
        scale, along, total = torch.rsqrt(variance + ctx.eps), torch.zeros_like(mean), torch.zeros_like(mean)
        if len(own):
            _, along, total = torch.ops.aten.native_batch_norm_backward(
                own, counted, None, None, None, mean, scale, True, ctx.eps, [False, True, True]
            )
        sums = torch.stack([total, along])
        dist.all_reduce(sums)
        shift, slope = sums / count
        factor = (weight * scale)[:, None, None]
        normal = functional.batch_norm(counted, mean, variance, eps=ctx.eps)
        x_gradient = torch.zeros_like(gradient)
        correction = torch.addcmul(-factor * shift[:, None, None], normal, -factor * slope[:, None, None])
        torch.addcmul(correction, own, factor, out=x_gradient[: ctx.rows])
        return x_gradient, along, total, None, None, None, None, None
