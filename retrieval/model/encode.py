"""Forward pass of the towers in batches: images to partial activations and embeddings.

Inference folds batch normalisation into the preceding convolution and lays weights out with channels last. The
arithmetic is float32: bfloat16 would move the partial activations of the shipped checkpoint by up to an eighth of the
largest, and a query would not match an index that was built elsewhere.
"""

import copy
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from retrieval.errors import ConfigError
from retrieval.model.fusion import ImageEncoding, Matcher
from retrieval.model.touch_reader import EncodedTouches, TouchEncodings
from retrieval.model.towers.tower import Tower

T = TypeVar("T")
Image = NDArray[np.float32]


def to_batch(images: Sequence[Image], device: torch.device | str = "cpu") -> Tensor:
    """Stack images (H, W, 3) to (B, 3, H, W), channels last in memory."""
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).to(device)


def touch_batch(touches: Sequence[Sequence[Image]], device: torch.device | str = "cpu") -> Tensor:
    """Stack touches, each a sequence of finger images (H, W, 3), to (B, fingers, 3, H, W)."""
    stacked = torch.from_numpy(np.stack([np.stack(images) for images in touches]))
    return stacked.permute(0, 1, 4, 2, 3).to(device)


def for_inference(matcher: Matcher, tower: Literal["touch_tower", "photo_tower"]) -> Matcher:
    """Return a matcher that runs faster, for forward passes of one tower without gradients; this tower is a copy.

    On the shipped checkpoint the features differ by at most 3e-5 of the largest one. A tower in training mode is used
    unchanged, because its batch normalisation depends on the batch.
    """
    fast, original = copy.copy(matcher), matcher.get_submodule(tower)
    fast._modules = dict(matcher._modules)
    if not original.training:
        folded = copy.deepcopy(original).requires_grad_(False)
        _fold_batch_norm(folded)
        fast.add_module(tower, folded.to(memory_format=torch.channels_last))  # type: ignore[call-overload]  # torch's stub lacks it
    return fast


def _fold_batch_norm(module: nn.Module) -> None:
    """Fold each batch normalisation that is registered right after a convolution into it."""
    if isinstance(module, Tower) and not module.can_fold_batch_norm:
        return
    for (name, child), (after, normalisation) in itertools.pairwise(list(module.named_children())):
        if isinstance(child, nn.Conv2d) and isinstance(normalisation, nn.BatchNorm2d):
            module.add_module(name, fuse_conv_bn_eval(child, normalisation))
            module.add_module(after, nn.Identity())
    for child in module.children():
        _fold_batch_norm(child)


def touch_features(matcher: Matcher, touches: Iterable[Sequence[Image]]) -> Tensor:
    """Return features (B, fingers * features) of touches, each a sequence of finger images (H, W, 3) in 0..1."""
    fast = for_inference(matcher, "touch_tower")
    device = next(fast.parameters()).device
    return _in_batches(touches, 32, lambda part: fast.touch_features(touch_batch(part, device)))


def photo_features(matcher: Matcher, photos: Iterable[Image]) -> Tensor:
    """Return features (B, features) of photos (H, W, 3) in 0..1."""
    fast = for_inference(matcher, "photo_tower")
    device = next(fast.parameters()).device
    return _in_batches(photos, 16, lambda part: fast.photo_features(to_batch(part, device)))


@torch.inference_mode()
def encode_touches(matcher: Matcher, touches: Iterable[Sequence[Image]]) -> ImageEncoding:
    """Return partial activations and embeddings of touches, each a sequence of finger images (H, W, 3), on the CPU.

    >>> checkpoint = retrieval.load_checkpoint("model.safetensors")
    >>> gels = [checkpoint.config.preprocessing.load_touch(file) for file in ("a.png", "b.png")]
    >>> retrieval.encode_touches(checkpoint.matcher, [gels]).embedding.shape
    torch.Size([1, 16])
    """
    return ImageEncoding(*(part.cpu() for part in matcher.touch_search_encoding(touch_features(matcher, touches))))


@torch.inference_mode()
def encode_photos(matcher: Matcher, photos: Iterable[Image]) -> ImageEncoding:
    """Return partial activations and embeddings of photos (H, W, 3), on the CPU.

    >>> checkpoint = retrieval.load_checkpoint("model.safetensors")
    >>> photo = checkpoint.config.preprocessing.load_photo("catalog/mug/1.jpg")
    >>> retrieval.encode_photos(checkpoint.matcher, [photo]).partial.shape
    torch.Size([1, 32])
    """
    return ImageEncoding(*(part.cpu() for part in matcher.photo_search_encoding(photo_features(matcher, photos))))


class TorchEncoder:
    """Touch encoder for a sequence of queries to one unchanging model: `encode_touches` in PyTorch."""

    name = "torch"

    def __init__(self, matcher: Matcher, threads: int | None = None) -> None:
        """Prepare the towers; PyTorch computes with `threads` from then on, in the whole process (None: no change)."""
        self._fast, self._threads = for_inference(matcher, "touch_tower"), threads

    @torch.inference_mode()
    def encode(self, touches: Sequence[Sequence[Image]]) -> TouchEncodings:
        """Encode grasps, each a sequence of its fingers' images."""
        if self._threads is not None:
            torch.set_num_threads(self._threads)  # applies to the calling thread
        partials, embeddings, *readings = self._fast.encode_touches(touch_batch(touches))
        return TouchEncodings(partials.numpy(), embeddings.numpy(), readings[0].numpy() if readings else None)


PhotoEncoder = Callable[[Sequence[Image]], EncodedTouches]
"""Encodes images (H, views * W, 3) on the calling thread; several threads may call it at once."""


def torch_photo_encoder(matcher: Matcher) -> PhotoEncoder:
    """Return an encoder by a matcher's own towers."""
    fast = for_inference(matcher, "photo_tower")
    device = next(matcher.parameters()).device

    @torch.inference_mode()
    def encode(images: Sequence[Image]) -> EncodedTouches:
        with one_thread():
            encoding = fast.photo_search_encoding(fast.photo_features(to_batch(images, device)))
        return EncodedTouches(encoding.embedding.cpu().numpy(), encoding.partial.cpu().numpy())

    return encode


@torch.inference_mode()
def _in_batches(items: Iterable[T], batch: int, encode: Callable[[list[T]], Tensor]) -> Tensor:
    return torch.cat([encode(part) for part in batches(items, batch)])


def batches(items: Iterable[T], size: int) -> Iterator[list[T]]:
    """Yield lists of `size` items, the last one possibly shorter."""
    iterator = iter(items)
    while part := list(itertools.islice(iterator, size)):
        yield part


def default_device() -> torch.device:
    """Return CUDA if available, else the CPU."""
    return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")


@contextmanager
def one_thread() -> Iterator[None]:
    """Make PyTorch compute only on the calling thread: if another program takes a worker's core, all others spin."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def autocast(device: torch.device, precision: str) -> AbstractContextManager[Any]:
    """Return the context for the towers' arithmetic in training.

    precision: "float32", "bfloat16", or "auto": bfloat16 if the device multiplies it in hardware, else float32.

    Raises:
        ConfigError: `precision` is bfloat16 and the device only emulates it, ten times slower than float32.
    """
    fast = has_fast_bfloat16(device)
    if precision == "bfloat16" and not fast:
        raise ConfigError(f"precision bfloat16 needs hardware support, which {device} lacks; use auto or float32")
    return torch.autocast(device.type, torch.bfloat16, enabled=fast and precision != "float32")


def has_fast_bfloat16(device: torch.device) -> bool:
    """Whether `device` multiplies bfloat16 in hardware."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    probes = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(getattr(torch.cpu, probe, lambda: False)() for probe in probes)
