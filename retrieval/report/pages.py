"""Pictures of pages: thumbnails, data URIs, and contact sheets of photo views."""

import base64
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from retrieval.console.files import write_output
from retrieval.data.camera import PhotoCamera
from retrieval.data.images import decode_rgb, read_bytes
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import resize

COLUMNS = 2
"""Photos per row of a contact sheet."""


def thumbnail(path: Path, px: int, digest: str | None = None) -> bytes:
    """Return the picture at `path` as a JPEG file whose longer side has at most `px` pixels.

    Raises:
        ImageError: The picture cannot be read, or its file has another SHA-256 than `digest`.
    """
    image = decode_rgb(read_bytes(path, digest), path)
    height, width = image.shape[:2]
    scale = min(1.0, px / max(height, width))
    image = resize(image, (max(1, round(height * scale)), max(1, round(width * scale))))
    samples = np.rint(image[..., ::-1] * 255).astype(np.uint8)
    return cv2.imencode(".jpg", samples, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()


def data_uri(data: bytes, kind: str) -> str:
    """Return an image file as a data URI; `kind` is "jpeg" or "png"."""
    return f"data:image/{kind};base64," + base64.b64encode(data).decode("ascii")


def write_views(photos: Mapping[Path, PhotoCamera], settings: Preprocessing, out: Path) -> None:
    """Write a PNG file with the views of photos, two photos per row.

    Args:
        photos: The photos, at least one, with their cameras.
        settings: Preprocessing that makes the views.
        out: File to write.

    Raises:
        ImageError: A photo cannot be read.
    """
    views = [np.rint(255 * settings.load_photo(*each)).astype(np.uint8) for each in photos.items()]
    blanks = [np.full_like(views[0], 255)] * (-len(views) % COLUMNS)
    sheet = np.concatenate([*views, *blanks]).reshape(-1, COLUMNS, *views[0].shape)
    sheet = np.vstack([np.hstack(list(row)) for row in sheet])
    write_output(out, cv2.imencode(".png", sheet[..., ::-1])[1].tobytes())
