"""Prepare pictures for the towers: decode, resize, subtract the gel's background.

gel image --decode_rgb--> (H, W, 3) --resize--> (px, px, 3) --subtract_background--> input of the touch tower
photo     --decode--> (H, W, 3) --find the object, sharpen, turn--> --tile_views--> input of the photo tower
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta

from _touch_retrieval.documents import check_fields
from retrieval.data.camera import USUAL_CAMERA, PhotoCamera
from retrieval.data.images import LOSSLESS, decode, picture_size, read_bytes, read_rgb
from retrieval.data.object_finder import FoundObject, find_object, network_digest, whole_photo
from retrieval.data.photo_faults import photo_faults
from retrieval.data.resize import RgbImage, Samples, resize
from retrieval.data.sharpening import blur_px, sharpen
from retrieval.data.upright import turn
from retrieval.data.views import VIEWS, min_photo_side, min_photo_side_for_crop, tile_views
from retrieval.errors import BadInput, ConfigError, NumericalError

PREPROCESSING_VERSION = 2
"""Increase it when the same file gives different values, so that older indexes and checkpoints do not match."""

BACKGROUNDS: dict[str, Callable[[RgbImage, RgbImage], RgbImage]] = {
    "none": lambda touch, reference: touch,
    "difference": lambda touch, reference: touch - reference,
    "difference+0.5": lambda touch, reference: np.clip(touch - reference + np.float32(0.5), 0, 1),
    "abs": lambda touch, reference: np.abs(touch - reference),
}
"""What a tower sees of a touch and its no-contact frame.

The arithmetic is float32: a uint8 subtraction wraps, and turns 1 grey level darker into 255 brighter.
"""

Side = Annotated[int, Meta(ge=1, le=4096)]
"""Side of a square in pixels."""


class PreparedPhoto(NamedTuple):
    """A photo as a tower takes it.

    Attributes:
        views: The tiled views (photo_px, views * photo_px, 3).
        faults: What makes its object harder to recognise (`retrieval.data.photo_faults.FAULTS`); empty for a model that
            takes the whole photo only.
    """

    views: RgbImage
    faults: tuple[str, ...]


@dataclass(frozen=True)
class Preprocessing:
    """Settings of the preparation of pictures for the towers.

    Attributes:
        touch_px: Side of a gel image in pixels.
        photo_px: Side of each view of a photo in pixels.
        background: One of BACKGROUNDS.
        views: Views of a photo, tiled side by side (`retrieval.data.views.VIEWS`).
        reduced: Whether a JPEG photo is decoded no larger than its views require.
    """

    touch_px: Side = 128
    photo_px: Side = 256
    background: str = "none"
    views: tuple[str, ...] = ("whole",)
    reduced: bool = False

    def __post_init__(self) -> None:
        check_fields(self, "preprocessing", ConfigError)
        if not self.views or not set(self.views) <= set(VIEWS) or len(set(self.views)) < len(self.views):
            raise ConfigError(
                f"preprocessing.views must be some of {', '.join(VIEWS)}, each once; got {list(self.views)}"
            )
        if self.background not in BACKGROUNDS:
            raise ConfigError(f"background must be one of {', '.join(BACKGROUNDS)}; got {self.background!r}")

    @property
    def finds_object(self) -> bool:
        """Whether a view depends on where the object is."""
        return self.views != ("whole",)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as JSON types."""
        return asdict(self) | {"views": list(self.views)}

    def digest(self) -> str:
        """Return the SHA-256 (hex) that is equal exactly when the same file gives the same values."""
        content = {"version": PREPROCESSING_VERSION, **self.to_dict()}
        if not self.finds_object:  # keeps the digest of checkpoints without this setting
            del content["views"]
        else:
            content |= {"object_finder": network_digest(), "sharpens": True}
        if not self.reduced:  # as above
            del content["reduced"]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def photo(self, image: RgbImage) -> RgbImage:
        """Return the tiled views (photo_px, views * photo_px, 3) of a photo (H, W, 3) in 0..1.

        Raises:
            BadInput: The photo has the wrong shape or type.
            NumericalError: A sample is not finite.
        """
        _require_rgb(image, "photo")
        _require_finite(image, "photo")
        return self._prepare(image, self._find(image), USUAL_CAMERA, is_lossy=False).views

    def photo_from_bytes(self, data: bytes, name: str | Path, camera: PhotoCamera = USUAL_CAMERA) -> PreparedPhoto:
        """Prepare the photo in the bytes of a file, called `name`, and examine it. Raises ImageError."""
        image, found = self._decode_photo(data, name, camera.field_mm)
        return self._prepare(image, found, camera, is_lossy=not data.startswith(LOSSLESS))

    def _prepare(self, image: Samples, found: FoundObject, camera: PhotoCamera, is_lossy: bool) -> PreparedPhoto:
        if not self.finds_object:
            return PreparedPhoto(tile_views(image, self.views, self.photo_px, found), ())
        measured_px = blur_px(image, found)
        faults = photo_faults(image, found, measured_px)
        image, found = sharpen(image, found, measured_px, is_lossy)
        if camera.roll_deg:
            image = turn(image, camera.roll_deg)
            found = find_object(image)
        return PreparedPhoto(tile_views(image, self.views, self.photo_px, found, camera.field_mm), faults)

    def _find(self, image: Samples) -> FoundObject:
        return find_object(image) if self.finds_object else whole_photo(image)

    def _decode_photo(self, data: bytes, name: str | Path, field_mm: float) -> tuple[Samples, FoundObject]:
        """Return a photo in the size that its views need, and its object."""
        image = decode(data, name, min_photo_side(self.views, self.photo_px, field_mm) if self.reduced else None)
        found, short = self._find(image), min(image.shape[:2])
        more = min_photo_side_for_crop(found, short, self.photo_px)
        if self.reduced and "crop" in self.views and short < min(more, *picture_size(data, name)):
            image = decode(data, name, more)
            found = found.scaled(min(image.shape[:2]) / short)
        return image, found

    def touch(self, image: RgbImage, reference: RgbImage | None = None) -> RgbImage:
        """Return a gel image (H, W, 3) in 0..1 as (touch_px, touch_px, 3), with the background subtracted.

        The subtraction follows the resizing: the two files may have different sizes, and the work is less. For "abs",
        sensor noise averages out before the absolute value, which would make it a grey offset.

        Args:
            image: The gel image.
            reference: Its no-contact frame; may be None for background "none".

        Raises:
            ConfigError: The background policy requires a reference, and it is missing.
            BadInput: An image has the wrong shape or type.
            NumericalError: A sample is not finite.
        """
        size = (self.touch_px, self.touch_px)
        _require_rgb(image, "touch")
        touch = resize(image, size)
        if self.background != "none":
            if reference is None:
                raise ConfigError(
                    f'background = "{self.background}" needs a no-contact frame for each touch: give a reference, or '
                    'set background = "none"'
                )
            _require_rgb(reference, "reference")
            touch = BACKGROUNDS[self.background](touch, resize(reference, size))
        _require_finite(touch, "touch")
        return touch

    def load_photo(self, path: str | Path, camera: PhotoCamera = USUAL_CAMERA) -> RgbImage:
        """Read a photo as (photo_px, views * photo_px, 3) float32. Raises ImageError."""
        return self.photo_from_bytes(read_bytes(path), path, camera).views

    def load_touch(self, path: str | Path, reference: str | Path | None = None) -> RgbImage:
        """Read one finger's gel image as (touch_px, touch_px, 3) float32.

        Args:
            path: File of the gel image.
            reference: File of the no-contact frame; not opened for background "none".

        Raises:
            ImageError: A file cannot be read or decoded.
            ConfigError: The background policy requires a reference, and it is missing.
        """
        no_contact = None if reference is None or self.background == "none" else read_rgb(reference)
        return self.touch(read_rgb(path), no_contact)


def _require_rgb(image: RgbImage, what: str) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0 or image.dtype != np.float32:
        shape = " x ".join(map(str, image.shape))
        raise BadInput(f"{what} must be H x W x 3 float32 in 0..1, got {shape} {image.dtype}; see to_float")


def _require_finite(image: RgbImage, what: str) -> None:
    if not np.isfinite(image).all():
        raise NumericalError(f"the {what} contains a NaN or infinite sample; every sample must be in 0..1")
