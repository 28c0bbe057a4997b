"""Base class of every tower; a backbone only implements `_encode`."""

import logging
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from retrieval.errors import BadInput, CheckpointError, ConfigError, NumericalError
from retrieval.model.towers import TOWER_SEPARATOR, TOWERS
from retrieval.model.towers.weights import GEL, SHIPPED, State, download, gel_tower, read_state

log = logging.getLogger(__name__)
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class Tower(nn.Module):
    """Encoder of one modality: RGB images to feature vectors.

    A subclass takes an output (`MatcherConfig.tower_output`), sets `feature_count`, the length of a vector, and
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
        """Make the parts that all towers have for a `MatcherConfig.tower_output`; a subclass makes its layers."""
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
        features, maps = self._encode_with_map(images)
        cells = _grid_means(maps.float(), self.cells)
        return torch.cat([features, cells.flatten(2).transpose(1, 2).flatten(1)], dim=1)

    def stem_layers(self) -> nn.Module:
        """Return the first layers, which `freeze_stem` keeps frozen.

        Raises:
            ConfigError: This kind of tower has no stem.
        """
        raise ConfigError(f"{type(self).__name__} has no stem to freeze; set freeze_stem = false")

    def _encode_with_map(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return features (B, feature_count) and a map (B, cell_channels, H', W') that is averaged over each cell."""
        raise NotImplementedError

    def _encode(self, images: Tensor) -> Tensor:
        """Encode normalised images (B, 3, H, W) to (B, feature_count)."""
        raise NotImplementedError

    @property
    def backbones(self) -> Sequence["Tower"]:
        """The concatenated towers; of any other tower, itself."""
        return [self]

    def initialise(self, init: str, shipped: Callable[[], State] | None = None) -> None:
        """Load the initial weights.

        Args:
            init: "random" leaves the tower as built. "imagenet" loads the published weights, "shipped" those of
                `shipped`, "gel" the file `gel_tower`. Anything else is the path of a state dict with the tower's key
                names. Concatenated towers take one value for all, or one each, joined by `TOWER_SEPARATOR`.
            shipped: Returns the state dict for "shipped".

        Raises:
            CheckpointError: A file is missing, damaged or of another architecture.
        """
        if init == "random":
            return
        if init == SHIPPED and shipped is not None:
            self.load(shipped(), "the shipped checkpoint")
        elif init == GEL:
            self.load(read_state(gel_tower()), "the gel tower of the package")
        elif init == "imagenet":
            if self.url is None:
                raise CheckpointError(f"no weights are published for {type(self).__name__}; give a file, or `random`")
            self.load(download(self.url), f"the published {type(self).__name__}")
        else:
            self.load(read_state(Path(init)), init)

    def load(self, state: State, source: str) -> None:
        """Load a state dict. Every layer must fit; either side may lack an optional one, and a count of batches.

        Args:
            state: The weights by name, perhaps in an older layout (`rename_state`).
            source: Their name in messages.

        Raises:
            CheckpointError: The weights are of another architecture, or not finite.
        """
        state, own, kind = self.rename_state(state), self.state_dict(), type(self).__name__
        optional, classes = self.optional_prefixes, self.optional_prefixes[:1]
        unknown = [key for key in state if key not in own and not key.startswith(optional)]
        # PyTorch before 0.4.1 stored no count of the batches of a normalisation.
        required = (key for key in own if not key.startswith(classes) and not key.endswith(".num_batches_tracked"))
        missing = [key for key in required if key not in state]
        if unknown or missing:
            problem = f"lacks {missing[0]}" if missing else f"has an unknown {unknown[0]}"
            raise CheckpointError(f"{source} does not fit {kind}: it {problem}; name the tower it is for")
        for key in (key for key in own if key in state):
            if state[key].shape != own[key].shape:
                got, expected = tuple(state[key].shape), tuple(own[key].shape)
                raise CheckpointError(f"{source} does not fit {kind}: {key} is {got}, must be {expected}")
            if not bool(torch.isfinite(state[key]).all()):
                raise CheckpointError(f"{source} contains a NaN or infinite weight in {key}; give another file")
        if any(key.startswith(classes) and key not in state for key in own):
            log.warning("%s has no 1000-way layer: this layer is initialised randomly", source)
        self.load_state_dict({key: state.get(key, value) for key, value in own.items()})

    @staticmethod
    def rename_state(state: State) -> State:
        """Map the keys of a known older layout to the current one; by default the identity."""
        return state


class ConcatenatedTowers(Tower):
    """Several backbones on one image, with concatenated features: differently pretrained ones complement each other."""

    def __init__(self, parts: Sequence[Tower]) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)
        self.feature_count = sum(part.feature_count for part in parts)

    @property
    def backbones(self) -> Sequence[Tower]:
        """The concatenated towers."""
        return list(self.parts)  # type: ignore[arg-type]

    def initialise(self, init: str, shipped: Callable[[], State] | None = None) -> None:
        """Load the initial weights of each part, as in `Tower.initialise`."""
        inits, count = init.split(TOWER_SEPARATOR), len(self.backbones)
        if len(inits) not in (1, count):
            raise CheckpointError(
                f"{count} concatenated towers need initial weights each, joined by {TOWER_SEPARATOR!r}; got {init!r}"
            )
        for part, part_init in zip(self.backbones, inits * (count // len(inits)), strict=True):
            part.initialise(part_init, shipped)

    def _encode(self, images: Tensor) -> Tensor:
        return torch.cat([part._encode(images) for part in self.backbones], dim=1)


def build_tower(name: str, output: str = "pooled") -> Tower:
    """Build the tower `name`, or several concatenated ones, with random weights.

    Args:
        name: A row of `TOWERS`, or "module:Class" of an imported module.
        output: "pooled": averages of the last stage; "classes": the 1000-way layer of ImageNet checkpoints, as in the
            paper; "stages": mean, deviation and maximum over the maps of several stages.

    Raises:
        ConfigError: The name is unknown.
    """
    if TOWER_SEPARATOR in name:
        return ConcatenatedTowers([build_tower(part, output) for part in name.split(TOWER_SEPARATOR)])
    tower: Tower = TOWERS.load(name)(output)
    return tower


def _grid_means(maps: Tensor, cells: int) -> Tensor:
    """Return the means (B, C, cells, cells) of maps (B, C, H, W) over the cells of a grid."""
    height, width = (int(side) for side in maps.shape[2:])
    if height % cells or width % cells:
        return nn.functional.adaptive_avg_pool2d(maps, cells)  # the ONNX exporter lacks this one
    return nn.functional.avg_pool2d(maps, (height // cells, width // cells))


def without_autocast(images: Tensor) -> AbstractContextManager[Any]:
    """Return a context that computes the first layers in float32, even if the others use bfloat16.

    Gels differ by a few grey levels, which rounding to bfloat16 removes: the gradient of MobileNetV2 then has a cosine
    of 0.75 with that in float32, and of 0.96 with the layers up to stride 4 in float32.
    """
    kind = images.device.type
    return torch.autocast(kind, enabled=False) if torch.is_autocast_enabled(kind) else nullcontext()


_ROUNDINGS = 4
"""A map's rounding, after several layers, in units of that of one number."""


def stage_statistics(maps: Iterable[Tensor]) -> Tensor:
    """Return mean, standard deviation and maximum over each map (B, C, H, W), concatenated: (B, 3 * all C)."""
    parts = []
    for x in maps:
        rounding = torch.finfo(x.dtype).eps
        x = x.to(torch.promote_types(x.dtype, torch.float32))
        # Not the root of the variance, whose slope is infinite if a map is constant; the slope of `std` is 0 then.
        deviation = x.std((2, 3), correction=0)
        # A deviation below the map's rounding is noise, and so is its gradient, which is as long as any other.
        is_noise = deviation <= _ROUNDINGS * rounding * x.abs().amax((2, 3))
        parts += [x.mean((2, 3)), torch.where(is_noise, deviation.detach(), deviation), x.amax((2, 3))]
    return torch.cat(parts, dim=1)
