"""What every tower owes its callers; a backbone only writes `_encode`."""

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn

from retrieval.errors import BadInput, NumericalError

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class Tower(nn.Module):
    """Encoder of one modality: RGB images to feature vectors.

    `feature_count` is the length of a vector. `optional_prefixes` begin the names of weights that published
    checkpoints hold and that some outputs of the tower do not need, the 1000-way layer first.
    """

    feature_count: int
    optional_prefixes: tuple[str, ...]
    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        # Not persistent: the state dict holds exactly the keys that ImageNet checkpoints hold.
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Encode images (B, 3, H, W), float32 RGB within -1..1 (0..1 unless differences), to (B, feature_count).

        Raises BadInput for another shape, type or range, NumericalError for a NaN or infinite pixel.
        """
        if images.ndim != 4 or images.shape[1] != 3:
            raise BadInput(f"a tower takes RGB images shaped (B, 3, H, W); got {tuple(images.shape)}")
        if images.dtype != torch.float32:
            raise BadInput(f"a tower takes float32 images in 0..1; got {images.dtype}; divide 8-bit images by 255")
        if images.shape[0] == 0:
            raise BadInput("a tower takes at least one image; got an empty batch")
        low, high = (float(bound) for bound in torch.aminmax(images))
        if not (abs(low) < float("inf") and abs(high) < float("inf")):
            raise NumericalError("a tower takes finite pixels; got a NaN or infinite one")
        if max(-low, high) > 1.0 + 1e-4:  # averages of pixels may round past 1
            raise BadInput(f"a tower takes pixels within -1..1; got {low:.3g}..{high:.3g}; divide 8-bit images by 255")
        return self._encode((images - self.mean) / self.std)

    def _encode(self, images: Tensor) -> Tensor:
        """Encode normalised images (B, 3, H, W) to (B, feature_count)."""
        raise NotImplementedError

    @staticmethod
    def rename_state(state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Map the keys of a known older layout to today's; the identity unless a backbone has one."""
        return state


def unrounded(images: Tensor) -> AbstractContextManager[Any]:
    """What the first layers are computed in: float32 also where the others multiply in bfloat16.

    Gels differ by a few grey levels, which is what bfloat16 rounds away from an image: the gradient of MobileNetV2 in
    bfloat16 then has a cosine of 0.75 with that in float32, and of 0.96 with the layers up to stride 4 in float32.
    """
    if torch.is_autocast_enabled(images.device.type):
        return torch.autocast(images.device.type, enabled=False)
    return nullcontext()


def stage_statistics(maps: Iterable[Tensor]) -> Tensor:
    """Mean, standard deviation and maximum over each of several maps (B, C, H, W), side by side: (B, 3 * all C).

    The mean alone thins out what covers a small part of an image; deviation and maximum keep it.
    """
    parts = []
    for x in maps:
        # Not the root of the variance, whose slope is infinite where a map is constant; that of `std` is 0 there.
        parts += [x.mean((2, 3)), x.std((2, 3), correction=0), x.amax((2, 3))]
    return torch.cat(parts, dim=1)
