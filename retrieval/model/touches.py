"""Gel images in any form: a file, bytes, a Pillow image or an array; one grasp or several.

The nesting of the lists determines which:

    [a, b]             one grasp: an image for each finger of the model
    [[a, b], [a, b]]   several grasps of one object
    a                  one grasp of a model with one finger
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from retrieval.data.images import check_pixels, decode_rgb, encode_image, pillow_rgb, read_bytes, read_rgb
from retrieval.data.resize import RgbImage, to_float
from retrieval.errors import BadInput, ImageError


@dataclass(frozen=True, eq=False)
class GelImage:
    """A gel image that another process read and resized.

    Attributes:
        touch: (px, px, 3) float32 RGB in 0..1 for a model whose `touch_px` is px.
        file: Bytes of its file.
    """

    touch: RgbImage
    file: bytes = b""


AnyImage: TypeAlias = str | os.PathLike[str] | bytes | bytearray | memoryview | Image.Image | NDArray[Any] | GelImage
"""A path (as text or `PathLike`), the bytes of a file, a Pillow image, an array (H, W, 3) uint8 in RGB order, or a gel
image that another process read."""
AnyTouches: TypeAlias = AnyImage | Sequence[AnyImage] | Sequence[Sequence[AnyImage]]
"""One grasp or several, nested as described above. An array with 4 or 5 axes is a list of its entries."""

_IMAGE_TYPES = "a path, the bytes of a file, a Pillow image or a uint8 array (height, width, 3)"
_NESTING_HINT = "one grasp is a list with an image for each finger, several grasps are a list of such lists"


@dataclass(frozen=True, eq=False)
class InputImage:
    """An image that is not read yet, its name in answers and messages (for a file, the path), and perhaps its file."""

    image: AnyImage
    name: str
    file: bytes = b""


def read_image(image: AnyImage, name: str) -> RgbImage:
    """Return an image of any form as (H, W, 3) float32 RGB in 0..1, the same for all forms of a picture.

    Raises:
        ImageError: The image is not readable. `name` is its name in the message, if it is not a file.
    """
    if isinstance(image, str | os.PathLike):
        return read_rgb(os.fspath(image))
    if isinstance(image, bytes | bytearray | memoryview):
        return decode_rgb(bytes(image), name)
    if isinstance(image, Image.Image):
        return pillow_rgb(image, name)
    if not isinstance(image, np.ndarray):
        raise ImageError(name, f"an image must be {_IMAGE_TYPES}, got {type(image).__name__}")
    if image.dtype != np.uint8:
        raise ImageError(
            name,
            f"an array must contain uint8 samples in 0..255, got {image.dtype}; convert samples in 0..1 with "
            "np.rint(255 * image).astype(np.uint8)",
        )
    if image.ndim != 3 or image.shape[2] != 3:
        raise ImageError(
            name,
            f"an array must be (height, width, 3) in RGB order, got {image.shape}; repeat a grey image with "
            "np.stack([image] * 3, axis=-1), drop an alpha channel, and put channels last",
        )
    check_pixels((image.shape[1], image.shape[0]), name)
    return np.ascontiguousarray(to_float(np.asarray(image)))


def image_file(source: InputImage) -> bytes:
    """Return the file of an image: its own, or a PNG file of its pixels. Raises ImageError."""
    image = source.image
    if isinstance(image, GelImage):
        assert image.file, "a gel image that another process read must have its file"
        return image.file
    if isinstance(image, str | os.PathLike):
        return read_bytes(os.fspath(image))
    if isinstance(image, bytes | bytearray | memoryview):
        return bytes(image)
    return encode_image(np.rint(255 * read_image(image, source.name)).astype(np.uint8))


def with_file(source: InputImage) -> InputImage:
    """Return an image that is read from its file, with this file in `file`. Raises ImageError."""
    file = image_file(source)
    return InputImage(source.image if isinstance(source.image, GelImage) else file, source.name, file)


def parse_grasps(touches: AnyTouches, fingers: int, *, noun: str = "touch", of: str = "") -> list[list[InputImage]]:
    """Return the grasps of one object, each with an image per finger. No image is read.

    Args:
        touches: One grasp or several, nested as described above.
        fingers: Images per grasp.
        noun: Noun for one grasp in messages.
        of: Prefix of messages, such as "object 3, ".

    Raises:
        BadInput: The nesting or the number of images is wrong.
    """
    if _is_image(touches):
        grasps: list[list[Any]] = [[touches]]
    else:
        items = _items(touches)
        images = [_is_image(item) for item in items]
        if any(images) and not all(images):
            raise BadInput(f"{of}a list mixes images with lists of images; {_NESTING_HINT}")
        grasps = [items] if any(images) else [_items(item) for item in items]
    if wrong := [image for grasp in grasps for image in grasp if not _is_image(image)]:
        raise BadInput(
            f"{of}an image must be {_IMAGE_TYPES}, got {type(wrong[0]).__name__}; {_NESTING_HINT}; query several "
            "objects with query_many"
        )
    if not grasps:
        raise BadInput(f"{of}give at least one {noun}: {_NESTING_HINT}")
    named = [
        [InputImage(image, _name(image, f"{of}grasp {g}", finger)) for finger, image in enumerate(grasp)]
        for g, grasp in enumerate(grasps, start=1)
    ]
    for grasp in named:
        if len(grasp) != fingers:
            raise BadInput(
                f"{of}this model takes {fingers} gel image(s) for one {noun}; got {len(grasp)}: "
                f"{', '.join(image.name for image in grasp)} ({_NESTING_HINT}; on the command line, use one --gelsight "
                "for each grasp)"
            )
    return named


def _is_image(item: object) -> bool:
    if isinstance(item, np.ndarray):
        return item.ndim <= 3
    return isinstance(item, str | os.PathLike | bytes | bytearray | memoryview | Image.Image | GelImage)


def _items(value: object) -> list[Any]:
    return list(value) if isinstance(value, Sequence | np.ndarray) else [value]


def _name(image: AnyImage, grasp: str, finger: int) -> str:
    if isinstance(image, str | os.PathLike):
        return os.fspath(image)
    return f"{grasp}, finger {ascii_lowercase[finger : finger + 1] or finger + 1}"
