"""Resize pictures: the mean of the area along an axis that shrinks, linear interpolation along one that grows."""

from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from retrieval.errors import BadInput

RgbImage = npt.NDArray[np.float32]
"""(H, W, 3) float32, red first, 0..1 (-1..1 after a background was subtracted)."""
Samples: TypeAlias = npt.NDArray[np.uint8] | RgbImage
"""A picture (H, W, C) of 8 bits, 0..255, or in float32."""

_BAND = 1 << 18
"""Approximate number of pixels of an 8-bit picture that are converted to float32 at once."""


def resize(image: RgbImage, size: tuple[int, int]) -> RgbImage:
    """Resize `image` (H, W, 3) float32 to `size` = (height, width) pixels.

    The aspect ratio is not kept, and nothing is cropped: the paper found cropping worse. An axis that shrinks is
    averaged over the area of each new pixel. An axis that grows is interpolated linearly between pixel centres (the
    edge repeats). cv2.INTER_AREA drops overlaps below 0.001 pixel, and overlaps are multiples of 1 / new side. So the
    mean is exact to 1e-6 below 1000 pixels, and to 0.001 from there on.

    Raises:
        BadInput: The image has the wrong shape or type, or the size is empty.
    """
    check_rgb(image, "image")
    if min(size) < 1:
        raise BadInput(f"the new size must be at least 1 x 1 pixel, got {size[0]} x {size[1]}")
    return resize_unchecked(image, size)


def to_unit(image: Samples) -> RgbImage:
    """Return the picture in float32, 0..1."""
    unit: RgbImage = image if image.dtype == np.float32 else np.divide(image, 255, dtype=np.float32)  # type: ignore[assignment]
    return unit


def resize_unchecked(samples: Samples, size: tuple[int, int]) -> RgbImage:
    """Resize like `resize`, without checks, for pictures (H, W, C) of any number of channels."""
    image = samples
    for axis in sorted((0, 1), key=lambda axis: size[axis] / samples.shape[axis]):  # shrink before growing
        if image.shape[axis] != size[axis]:
            image = (_shrink if size[axis] < image.shape[axis] else _grow)(image, axis, size[axis])
    return to_unit(image)


def _shrink(image: Samples, axis: int, length: int) -> RgbImage:
    """Shrink one axis, in bands of the other axis, so that few samples are in float32 at once."""
    other, bands = 1 - axis, []
    count = min(image.shape[other], -(-image[..., 0].size // _BAND))
    for band in np.array_split(image, count, axis=other):
        shape = (length, *band.shape[1:]) if axis == 0 else (len(band), length, band.shape[2])
        unit = to_unit(band)  # type: ignore[arg-type]
        bands.append(cv2.resize(unit, shape[1::-1], interpolation=cv2.INTER_AREA).reshape(shape))
    return np.concatenate(bands, axis=other)


def _grow(image: Samples, axis: int, length: int) -> RgbImage:
    """Interpolate one axis linearly.

    cv2.INTER_LINEAR rounds positions to float32 first: its pixels differ by up to 1e-7, and partial activations,
    stored as float16, by up to 1e-3 of their value.
    """
    unit, old = to_unit(image), image.shape[axis]
    position = np.clip((np.arange(length) + 0.5) * (old / length) - 0.5, 0, old - 1)
    left = np.minimum(position.astype(np.int64), max(old - 2, 0))
    weight = (position - left).reshape((-1, 1, 1) if axis == 0 else (-1, 1))
    right = np.minimum(left + 1, old - 1)
    grown: RgbImage = unit.take(left, axis) * (1 - weight).astype(np.float32)
    grown += unit.take(right, axis) * weight.astype(np.float32)
    return grown


def check_rgb(image: RgbImage, what: str) -> None:
    """Raise BadInput unless `image`, called `what`, is (H, W, 3) float32."""
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0 or image.dtype != np.float32:
        shape = " x ".join(map(str, image.shape))
        raise BadInput(f"{what} must be H x W x 3 float32 in 0..1, got {shape} {image.dtype}; see to_float")
