"""Images in, halves and embeddings out: the forward pass of the towers, in batches."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import islice
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retrieval.errors import ConfigError
from retrieval.fusion import Code, Matcher

T = TypeVar("T")
Image = NDArray[np.float32]


def to_batch(images: Sequence[Image], device: torch.device | str = "cpu") -> Tensor:
    """Stack images (H, W, 3) to (B, 3, H, W), channels last in memory."""
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).to(device)


def touch_batch(touches: Sequence[Sequence[Image]], device: torch.device | str = "cpu") -> Tensor:
    """Stack touches, each a sequence of finger images (H, W, 3), to (B, fingers, 3, H, W)."""
    stacked = torch.from_numpy(np.stack([np.stack(images) for images in touches]))
    return stacked.permute(0, 1, 4, 2, 3).to(device)


def touch_features(matcher: Matcher, touches: Iterable[Sequence[Image]], batch: int = 32) -> Tensor:
    """Features (B, fingers * features) of touches, each a sequence of finger images (H, W, 3) in 0..1."""
    device = next(matcher.parameters()).device
    return _in_batches(touches, batch, lambda part: matcher.touch_features(touch_batch(part, device)))


def photo_features(matcher: Matcher, photos: Iterable[Image], batch: int = 16) -> Tensor:
    """Features (B, features) of photos (H, W, 3) in 0..1."""
    device = next(matcher.parameters()).device
    return _in_batches(photos, batch, lambda part: matcher.photo_features(to_batch(part, device)))


@torch.inference_mode()
def encode_touches(matcher: Matcher, touches: Iterable[Sequence[Image]], batch: int = 32) -> Code:
    """Halves and embeddings of touches, on the CPU."""
    code = matcher.touch_entry(touch_features(matcher, touches, batch))
    return Code(code.half.cpu(), code.embedding.cpu())


@torch.inference_mode()
def encode_photos(matcher: Matcher, photos: Iterable[Image], batch: int = 16) -> Code:
    """Halves and embeddings of photos, on the CPU."""
    code = matcher.photo_entry(photo_features(matcher, photos, batch))
    return Code(code.half.cpu(), code.embedding.cpu())


@torch.inference_mode()
def _in_batches(items: Iterable[T], batch: int, encode: Callable[[list[T]], Tensor]) -> Tensor:
    return torch.cat([encode(part) for part in batches(items, batch)])


def batches(items: Iterable[T], size: int) -> Iterator[list[T]]:
    """Lists of `size` items, the last one shorter."""
    iterator = iter(items)
    while part := list(islice(iterator, size)):
        yield part


def default_device() -> torch.device:
    """CUDA where there is one, else the CPU."""
    return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch computes on the calling thread alone. Its workers wait for each other many times a step, and where one
    finds its core taken by another program all the others spin: milliseconds become hundreds."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def autocast(device: torch.device, precision: str) -> AbstractContextManager[Any]:
    """Context for the towers' arithmetic in training.

    precision: "float32", "bfloat16", or "auto": bfloat16 where the hardware multiplies it, float32 elsewhere (a CPU
    without such instructions emulates bfloat16, ten times slower than float32). Raises ConfigError for bfloat16 asked
    for where it is only emulated.
    """
    fast = has_fast_bfloat16(device)
    if precision == "bfloat16" and not fast:
        raise ConfigError(f"precision bfloat16 needs hardware for it, which {device} has not; use auto or float32")
    return torch.autocast(device.type, torch.bfloat16, enabled=fast and precision != "float32")


def has_fast_bfloat16(device: torch.device) -> bool:
    """Whether `device` multiplies bfloat16 in hardware."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    probes = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(getattr(torch.cpu, probe, lambda: False)() for probe in probes)
