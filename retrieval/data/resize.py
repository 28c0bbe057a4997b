"""Resizing pictures: averages where an axis shrinks, straight lines where it grows; numpy alone.

scipy's sparse matrices give the same numbers, bit for bit, and importing them takes longer than a query.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from retrieval.errors import BadInput

RgbImage = npt.NDArray[np.float32]
"""(H, W, 3) float32, red first, 0..1 (-1..1 after a background was subtracted)."""
Samples: TypeAlias = npt.NDArray[np.uint8] | RgbImage
"""A picture (H, W, C) of 8 bits, 0..255, or in float32."""
Resize: TypeAlias = Callable[[Samples, tuple[int, int]], RgbImage]
"""`resized`, or what gives the same faster."""


def resize(image: RgbImage, size: tuple[int, int]) -> RgbImage:
    """Resize `image` (H, W, 3) float32 to `size` = (height, width) pixels.

    Aspect is not kept and nothing is cropped: the paper tried cropping and found it worse.
    An axis that shrinks is averaged over the exact area of each new pixel, an axis that grows is interpolated
    linearly between pixel centres (the edge repeats), an equal axis is left as it is. Each axis is mixed with
    weights that sum to 1, so a constant stays constant (cv2.INTER_AREA drops overlaps below 0.001 pixel:
    5000 to 4999 turns 1.0 into 0.9992). float32 sums of n samples: error below n * 6e-8. Raises BadInput.
    """
    check_rgb(image, "image")
    if min(size) < 1:
        raise BadInput(f"the new size must be at least 1 x 1 pixel, got {size[0]} x {size[1]}")
    return resized(image, size)


def to_unit(image: Samples) -> RgbImage:
    """The picture in float32, 0..1."""
    unit: RgbImage = image if image.dtype == np.float32 else np.divide(image, 255, dtype=np.float32)  # type: ignore[assignment]
    return unit


def resized(samples: Samples, size: tuple[int, int]) -> RgbImage:
    """As `resize`, for pictures (H, W, C) of any number of channels, and without its checks."""
    image = samples
    for axis in axes(image.shape, size):
        image = _resize_axis(image, axis, size[axis])
    return to_unit(image)


def axes(old: Sequence[int], new: Sequence[int]) -> list[int]:
    """Which of an image's two axes change in length, in the order in which they are resized: shrink before growing."""
    return [axis for axis in sorted((0, 1), key=lambda axis: new[axis] / old[axis]) if old[axis] != new[axis]]


def _resize_axis(image: Samples, axis: int, length: int) -> RgbImage:
    """Mix rows, or columns where they lie: to turn the image over, so that columns are rows, takes five times as long
    as to mix them. Only the samples of one tap are in float32 at once."""
    table = np.ascontiguousarray(image).reshape(image.shape[0], -1)
    columns, weights = axis_weights(image.shape[axis], length)
    channels = image.shape[2]
    if axis:
        columns = (channels * columns[..., None] + np.arange(channels)).reshape(len(columns), -1)
        weights = np.repeat(weights, channels, axis=1)[:, None, :]
    else:
        weights = weights[:, :, None]
    mixed = to_unit(table.take(columns[0], axis=axis))
    mixed *= weights[0]
    part = np.empty_like(mixed)
    taken = part if table.dtype == np.float32 else np.empty(part.shape, np.uint8)
    for column, weight in zip(columns[1:], weights[1:], strict=True):
        np.take(table, column, axis=axis, out=taken, mode="clip")  # other modes copy once more; all columns are inside
        if taken is not part:
            np.divide(taken, 255, out=part, dtype=np.float32)
        part *= weight
        mixed += part
    out: RgbImage = mixed.reshape((-1, length, channels) if axis else (length, -1, channels))
    return out


@lru_cache(maxsize=64)
def axis_weights(old: int, new: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    """Which old samples each of the `new` ones is mixed from, and by what weights: two arrays (n, new), n the most that
    any one needs; weights add up to 1."""
    rows, columns, weights = (_area_weights if new < old else _linear_weights)(old, new)
    order = np.argsort(rows, kind="stable")
    rows, columns = rows[order], columns[order]
    first = np.searchsorted(rows, np.arange(new))
    place = np.arange(len(rows)) - first[rows]
    taken = np.tile(columns[first], (place.max() + 1, 1))  # samples of weight 0 where a new one has fewer
    shares = np.zeros(taken.shape, dtype=np.float32)
    taken[place, rows], shares[place, rows] = columns, weights[order]
    return taken, shares


_Triplets = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.float64]]


def _area_weights(old: int, new: int) -> _Triplets:
    """Cut the axis, old * new units long, at all edges of old and new pixels: a piece lies in one of each."""
    cuts = np.union1d(np.arange(old + 1) * new, np.arange(new + 1) * old)
    return cuts[:-1] // old, cuts[:-1] // new, np.diff(cuts) / old


def _linear_weights(old: int, new: int) -> _Triplets:
    position = np.clip((np.arange(new) + 0.5) * (old / new) - 0.5, 0, old - 1)
    left = np.minimum(position.astype(np.int64), max(old - 2, 0))
    right = np.minimum(left + 1, old - 1)
    share = position - left
    rows = np.tile(np.arange(new), 2)
    return rows, np.concatenate([left, right]), np.concatenate([1 - share, share])


def check_rgb(image: RgbImage, what: str) -> None:
    """Raise BadInput unless `image`, called `what`, is (H, W, 3) float32."""
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0 or image.dtype != np.float32:
        shape = " x ".join(map(str, image.shape))
        raise BadInput(f"{what} must be H x W x 3 float32 in 0..1, got {shape} {image.dtype}; see to_float")
