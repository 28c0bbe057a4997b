"""Base class of every tower; a backbone only implements `_encode`."""

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from retrieval.errors import BadInput, CheckpointError, ConfigError, NumericalError
from retrieval.model.towers.weights import State, download

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class Tower(nn.Module):
    """Encoder of one modality: RGB images to feature vectors.

    A subclass takes an output (`retrieval.model.towers.OUTPUTS`), sets `feature_count`, the length of a vector, and
    implements `_encode`.

    >>> import torch
    >>> class Average(retrieval.Tower):
    ...     def __init__(self, output):
    ...         super().__init__(output)
    ...         self.feature_count = 8
    ...         self.linear = torch.nn.Linear(3, 8)
    ...     def _encode(self, images):
    ...         return self.linear(images.mean((2, 3)))
    >>> Average("pooled")(torch.rand(2, 3, 64, 64)).shape
    torch.Size([2, 8])
    """

    feature_count: int
    cell_channels: int = 0
    """Channels of a cell; 0 for a tower that has no cells, because it does not implement `_encode_with_map`."""
    optional_prefixes: ClassVar[tuple[str, ...]] = ()
    """Prefixes of weights that published checkpoints contain and some outputs of the tower do not need; the 1000-way
    layer first."""
    can_fold_batch_norm: ClassVar[bool] = True
    """Whether a batch normalisation that is registered right after a convolution takes its output, so that the two can
    be folded for inference."""
    url: ClassVar[str | None] = None
    """URL of the published ImageNet weights."""
    mean: Tensor
    std: Tensor

    def __init__(self, output: str = "pooled") -> None:
        """Make the parts that all towers have; a subclass makes its layers.

        Args:
            output: One of `retrieval.model.towers.OUTPUTS`.
        """
        super().__init__()
        self.output = output
        self.cells = 0
        # Not persistent: the state dict has exactly the keys of ImageNet checkpoints.
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Encode images (B, 3, H, W), float32 RGB within -1..1 (0..1 unless differences), to (B, output_count).

        The features come first, then the cells row by row.

        Raises:
            BadInput: Another shape, type or range.
            NumericalError: A NaN or infinite pixel.
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
        return self.encode_unchecked(images)

    @property
    def output_count(self) -> int:
        """Length of an output: the features, then the channels of all cells."""
        return self.feature_count + self.cells**2 * self.cell_channels

    def divide(self, cells: int) -> "Tower":
        """Append a grid of `cells` x `cells` cells to each output, and return this tower.

        Raises:
            ConfigError: This kind of tower has no cells.
        """
        if cells and not self.cell_channels:
            raise ConfigError(f"{type(self).__name__} has no cells, so it cannot be used with cell_dim above 0")
        self.cells = cells
        return self

    def encode_unchecked(self, images: Tensor) -> Tensor:
        """Return `forward` without its checks of the images, which ONNX cannot express."""
        images = (images - self.mean) / self.std
        if not self.cells:
            return self._encode(images)
        return self._with_cells(*self._encode_with_map(images))

    def stem_layers(self) -> nn.Module:
        """Return the first layers, which `freeze_stem` keeps frozen.

        Raises:
            ConfigError: This kind of tower has no stem.
        """
        raise ConfigError(f"{type(self).__name__} has no stem to freeze; set freeze_stem = false")

    def _with_cells(self, features: Tensor, maps: Tensor) -> Tensor:
        cells = _grid_means(maps.float(), self.cells)
        return torch.cat([features, cells.flatten(2).transpose(1, 2).flatten(1)], dim=1)

    def _encode_with_map(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return features (B, feature_count) and a map (B, cell_channels, H', W') that is averaged over each cell."""
        raise NotImplementedError

    def _encode(self, images: Tensor) -> Tensor:
        """Encode normalised images (B, 3, H, W) to (B, feature_count)."""
        raise NotImplementedError

    def published_weights(self) -> State:
        """Return the weights that are published for this architecture. Raises CheckpointError if there are none."""
        if self.url is None:
            raise CheckpointError(f"no weights are published for {type(self).__name__}; give a file, or `random`")
        return download(self.url)

    @staticmethod
    def rename_state(state: State) -> State:
        """Map the keys of a known older layout to the current one; by default the identity."""
        return state


def _grid_means(maps: Tensor, cells: int) -> Tensor:
    """Return the means (B, C, cells, cells) of maps (B, C, H, W) over the cells of a grid."""
    height, width = (int(side) for side in maps.shape[2:])
    if height % cells or width % cells:
        return nn.functional.adaptive_avg_pool2d(maps, cells)  # the ONNX exporter lacks this one
    return nn.functional.avg_pool2d(maps, (height // cells, width // cells))


def without_autocast(images: Tensor) -> AbstractContextManager[Any]:
    """Return a context that computes the first layers in float32, even if the others use bfloat16.

    Gels differ by a few grey levels, which rounding an image to bfloat16 removes. The gradient of MobileNetV2 in
    bfloat16 then has a cosine of 0.75 with the gradient in float32, and of 0.96 with the layers up to stride 4 in
    float32.
    """
    if torch.is_autocast_enabled(images.device.type):
        return torch.autocast(images.device.type, enabled=False)
    return nullcontext()


def stage_statistics(maps: Iterable[Tensor]) -> Tensor:
    """Return mean, standard deviation and maximum over each map (B, C, H, W), concatenated: (B, 3 * all C).

    The mean dilutes a feature that covers a small part of an image; deviation and maximum preserve it.
    """
    parts = []
    for x in maps:
        # Not the root of the variance, whose slope is infinite if a map is constant; the slope of `std` is 0 then.
        parts += [x.mean((2, 3)), x.std((2, 3), correction=0), x.amax((2, 3))]
    return torch.cat(parts, dim=1)
