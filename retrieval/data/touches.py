"""Gel images however they are given: files, bytes, Pillow images or arrays, one grasp or several.

How deep the lists are nested says what is meant, so nothing is guessed:

    [a, b]             one grasp: an image for each finger of the model
    [[a, b], [a, b]]   several grasps of one object
    a                  one grasp of a model with one finger
"""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from retrieval.data.images import check_pixels, decode_rgb, pillow_rgb, read_rgb, to_float
from retrieval.data.resize import RgbImage
from retrieval.errors import BadInput, ImageError

AnyImage: TypeAlias = str | os.PathLike[str] | bytes | bytearray | memoryview | Image.Image | NDArray[Any]
"""A path (text is one), the bytes of a file, a Pillow image, or an array (H, W, 3) uint8, red first."""
AnyTouches: TypeAlias = AnyImage | Sequence[AnyImage] | Sequence[Sequence[AnyImage]]
"""One grasp or several, as the text above says. An array of 4 or 5 axes is a list of those below it."""

_WANTED = "a path, the bytes of a file, a Pillow image or a uint8 array (height, width, 3)"
_NESTED = "one grasp is a list with an image for each finger, several grasps are a list of such lists"


@dataclass(frozen=True, eq=False)
class GivenImage:
    """An image as it was given, not read yet. name: how answers and messages call it, a file by its path."""

    image: AnyImage
    name: str

    def read(self) -> RgbImage:
        """(H, W, 3) float32 RGB in 0..1; the same numbers however a picture is given. Raises ImageError."""
        return read_image(self.image, self.name)

    def loaded(self) -> "GivenImage":
        """Itself. A Pillow image reads its file when it is first asked for pixels, which two threads must not do at
        once: it does so here, before they do."""
        if isinstance(self.image, Image.Image):
            with suppress(Exception):  # told by `read`
                self.image.load()
        return self


def read_image(image: AnyImage, name: str) -> RgbImage:
    """An image however it is given as (H, W, 3) float32 RGB in 0..1; `name` stands for it where it is no file.

    Raises ImageError. Arrays must be uint8: of other types the range would have to be guessed.
    """
    if isinstance(image, str | os.PathLike):
        return read_rgb(os.fspath(image))
    if isinstance(image, bytes | bytearray | memoryview):
        return decode_rgb(bytes(image), name)
    return pillow_rgb(image, name) if isinstance(image, Image.Image) else _array_rgb(image, name)


def _array_rgb(image: NDArray[Any], name: str) -> RgbImage:
    if image.dtype != np.uint8:
        raise ImageError(
            name,
            f"an array must hold uint8 samples in 0..255, got {image.dtype}; make them of samples in 0..1 by "
            "np.rint(255 * image).astype(np.uint8)",
        )
    if image.ndim != 3 or image.shape[2] != 3:
        raise ImageError(
            name,
            f"an array must be (height, width, 3), red first, got {image.shape}; repeat a grey image by "
            "np.stack([image] * 3, axis=-1), leave an alpha channel out, and put channels last",
        )
    check_pixels((image.shape[1], image.shape[0]), name)
    return np.ascontiguousarray(to_float(np.asarray(image)))


def read_grasps(given: AnyTouches, fingers: int, *, what: str = "touch", of: str = "") -> list[list[GivenImage]]:
    """The grasps in what was given for one object, each with an image for each finger; no image is read.

    what: how one grasp is called in messages. of: what they begin with, such as "object 3, ". Raises BadInput where
    the nesting or the number of images is not as the text above says.
    """
    grasps = [_images_of(grasp, of) for grasp in _lists(given, of)]
    if not grasps:
        raise BadInput(f"{of}give at least one {what}: {_NESTED}")
    named = [[_given(image, g, f, of) for f, image in enumerate(grasp)] for g, grasp in enumerate(grasps, start=1)]
    for grasp in named:
        if len(grasp) != fingers:
            raise BadInput(
                f"{of}this model takes {fingers} gel image(s) for one {what}; got {len(grasp)}: "
                f"{', '.join(image.name for image in grasp)} ({_NESTED})"
            )
    return named


def _lists(given: AnyTouches, of: str) -> list[Any]:
    """A list for each grasp, by the depth of nesting."""
    if _is_image(given):
        return [[given]]
    items = _items(given, of)
    images = [_is_image(item) for item in items]
    if not any(images):
        return items
    if not all(images):
        raise BadInput(f"{of}images and lists of images stand side by side; {_NESTED}")
    return [items]


def _images_of(grasp: Any, of: str) -> list[AnyImage]:
    images = _items(grasp, of)
    for image in images:
        if not _is_image(image):
            raise BadInput(
                f"{of}an image must be {_WANTED}, got {type(image).__name__}; {_NESTED}; several objects go to "
                "query_many"
            )
    return images


def _is_image(item: object) -> bool:
    if isinstance(item, np.ndarray):
        return item.ndim <= 3
    return isinstance(item, str | os.PathLike | bytes | bytearray | memoryview | Image.Image)


def _items(given: object, of: str) -> list[Any]:
    if isinstance(given, Sequence | np.ndarray):
        return list(given)
    raise BadInput(f"{of}an image must be {_WANTED}, got {type(given).__name__}; {_NESTED}")


def _given(image: AnyImage, grasp: int, finger: int, of: str) -> GivenImage:
    if isinstance(image, str | os.PathLike):
        return GivenImage(image, os.fspath(image))
    letter = ascii_lowercase[finger] if finger < len(ascii_lowercase) else str(finger + 1)
    return GivenImage(image, f"{of}grasp {grasp}, finger {letter} ({_kind(image)})")


def _kind(image: Any) -> str:
    if isinstance(image, np.ndarray):
        return f"array {' x '.join(map(str, image.shape))} {image.dtype}"
    if isinstance(image, Image.Image):
        return f"Pillow image {image.width} x {image.height} {image.mode}"
    return f"{len(bytes(image))} bytes"
