"""Resize pictures: the mean of the area along an axis that shrinks, linear interpolation along one that grows."""

from typing import Any, TypeAlias

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


def resize(image: Samples, size: tuple[int, int]) -> RgbImage:
    """Resize `image` (H, W, C) to `size` = (height, width) pixels, in float32.

    The aspect ratio is not kept, and nothing is cropped: the paper found cropping worse. An axis that shrinks is
    averaged over the area of each new pixel. An axis that grows is interpolated linearly between pixel centres (the
    edge repeats). cv2.INTER_AREA drops overlaps below 0.001 pixel, and overlaps are multiples of 1 / new side. So the
    mean is exact to 1e-6 below 1000 pixels, and to 0.001 from there on.
    """
    growth = [new / old for new, old in zip(size, image.shape, strict=False)]
    for axis in sorted((0, 1), key=growth.__getitem__):  # shrink before growing
        if image.shape[axis] != size[axis]:
            image = (_shrink if size[axis] < image.shape[axis] else _grow)(image, axis, size[axis])
    return to_float(image)


def to_float(image: npt.NDArray[Any]) -> RgbImage:
    """Scale uint8 or uint16 samples of any shape to float32 in 0..1; float32 samples are returned as they are.

    Raises:
        BadInput: The samples have another type.
    """
    if image.dtype == np.float32:
        return image
    if image.dtype not in (np.uint8, np.uint16):
        raise BadInput(f"samples must be uint8 or uint16, got {image.dtype}")
    return np.asarray(np.divide(image, np.iinfo(image.dtype).max, dtype=np.float32))


def _shrink(image: Samples, axis: int, length: int) -> RgbImage:
    """Shrink one axis, in bands of the other axis, so that few samples are in float32 at once."""
    other, bands = 1 - axis, []
    count = min(image.shape[other], -(-image[..., 0].size // _BAND))
    for band in np.array_split(image, count, axis=other):
        shape = (length, *band.shape[1:]) if axis == 0 else (len(band), length, band.shape[2])
        bands.append(cv2.resize(to_float(band), shape[1::-1], interpolation=cv2.INTER_AREA).reshape(shape))
    return np.concatenate(bands, axis=other)


def _grow(image: Samples, axis: int, length: int) -> RgbImage:
    """Interpolate one axis linearly.

    cv2.INTER_LINEAR rounds positions to float32 first: its pixels differ by up to 1e-7, and partial activations,
    stored as float16, by up to 1e-3 of their value.
    """
    unit, old = to_float(image), image.shape[axis]
    position = np.clip((np.arange(length) + 0.5) * (old / length) - 0.5, 0, old - 1)
    left = np.minimum(position.astype(np.int64), max(old - 2, 0))
    weight = (position - left).reshape((-1, 1, 1) if axis == 0 else (-1, 1))
    right = np.minimum(left + 1, old - 1)
    grown: RgbImage = unit.take(left, axis) * (1 - weight).astype(np.float32)
    grown += unit.take(right, axis) * weight.astype(np.float32)
    return grown
