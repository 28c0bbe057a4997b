"""Random changes of training images that keep the relief."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional


def augment(images: Tensor, kind: str, rng: np.random.Generator, flipped: NDArray[np.bool_]) -> Tensor:
    """Return augmented images (B, 3, H, W) with the same relief.

    Images are turned by up to .1 rad, scaled by up to 8 %, shifted, flipped, relit, and get noise. Photos are also
    desaturated, since colour carries no information on relief. A gel's colours come from its lamps, which keep their
    places. So a gel image is only flipped top to bottom (the same press with a turned finger), and its channels are
    scaled equally.

    `images` (B, 3, H, W) are in 0..1, `kind` is "photo" or "touch", and `flipped` (B,) says which images are flipped.
    """
    count = len(images)

    def draw(low: float, high: float, *shape: int) -> Tensor:
        return torch.from_numpy(rng.uniform(low, high, (count, *shape)).astype(np.float32))

    turn, size = draw(-0.1, 0.1), draw(0.92, 1.08)
    flip = torch.from_numpy(np.where(flipped, -1.0, 1.0)).float()
    across, down = (flip, torch.ones(count)) if kind == "photo" else (torch.ones(count), flip)
    cosine, sine, shift = torch.cos(turn) * size, torch.sin(turn) * size, draw(-0.05, 0.05, 2)
    maps = torch.stack([across * cosine, -down * sine, shift[:, 0], across * sine, down * cosine, shift[:, 1]], 1)
    result = sample_affine(images, maps.view(count, 2, 3), images.shape[2], images.shape[3])
    if kind == "photo":
        grey, towards = result.mean(1, keepdim=True), draw(0.0, 1.0, 1, 1, 1)
        result = torch.lerp(result, grey.expand_as(result), (towards + 0.5).clamp(max=1.0) * (towards > 0.25))
        middle = result.mean((1, 2, 3), keepdim=True)
        result = (result - middle) * draw(0.7, 1.3, 1, 1, 1) + middle + draw(-0.15, 0.15, 1, 1, 1)
    else:
        result = (result - 0.5) * draw(0.7, 1.4, 1, 1, 1) + 0.5
    noise = torch.from_numpy(rng.standard_normal(result.shape, dtype=np.float32))
    return (result + 0.01 * noise).clamp(0.0, 1.0)


def augment_touches(touches: Tensor, flipped: NDArray[np.bool_], rng: np.random.Generator) -> Tensor:
    """Return augmented touches (B, fingers, 3, H, W); the fingers of a touch are flipped together."""
    fingers = touches.shape[1]
    result = augment(touches.flatten(0, 1), "touch", rng, flipped.repeat(fingers))
    # Channels last in memory, as convolutions need it.
    return result.contiguous(memory_format=torch.channels_last).view_as(touches)


def augment_photos(photos: Tensor, views: int, flipped: NDArray[np.bool_], rng: np.random.Generator) -> Tensor:
    """Return augmented photos (B, 3, H, views * W); the views of a photo are flipped together."""
    each = torch.stack(photos.chunk(views, dim=3), dim=1)
    result = augment(each.flatten(0, 1), "photo", rng, flipped.repeat(views)).view_as(each)
    return torch.cat(list(result.unbind(1)), dim=3).contiguous(memory_format=torch.channels_last)


def sample_affine(images: Tensor, maps: Tensor, height: int, width: int) -> Tensor:
    """Return images (B, 3, height, width), sampled from (B, 3, H, W) by affine maps (B, 2, 3) of coordinates."""
    grid = functional.affine_grid(maps, [len(images), 3, height, width], align_corners=False)
    return functional.grid_sample(images.contiguous(), grid, padding_mode="reflection", align_corners=False)
