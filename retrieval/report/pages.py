"""Parts of pages: templates, scripts, thumbnails, embedded images; and contact sheets of photo views."""

import base64
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from retrieval.console.files import write_output
from retrieval.data.images import read_rgb
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import resize
from retrieval.errors import ImageError

ThumbnailPixels = NDArray[np.uint8]
"""(H, W, 3) RGB."""
COLUMNS = 2
"""Photos per row of a contact sheet."""


def render(name: str, **values: Any) -> str:
    """Return the template `name`, filled with these values; their text is escaped."""
    source = (resources.files("retrieval") / "templates" / name).read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(source).render(**values)


def script(name: str) -> Markup:
    """Return a script of the package, for embedding in a page."""
    return Markup((resources.files("retrieval") / "templates" / name).read_text("utf-8"))


def thumbnail(path: Path, px: int) -> ThumbnailPixels | None:
    """Return the image at `path` with a longer side of at most `px`, or None if it cannot be read."""
    try:
        image = read_rgb(path)
    except ImageError:
        return None
    height, width = image.shape[:2]
    scale = min(1.0, px / max(height, width))
    image = resize(image, (max(1, round(height * scale)), max(1, round(width * scale))))
    return np.rint(image * 255).astype(np.uint8)


def jpeg(image: ThumbnailPixels) -> bytes:
    """Return the image as a JPEG file."""
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    return data.tobytes()


def data_uri(data: bytes, kind: str) -> str:
    """Return an image file as a data URI; `kind` is "jpeg" or "png"."""
    return f"data:image/{kind};base64," + base64.b64encode(data).decode("ascii")


def write_views(photos: Sequence[Path], settings: Preprocessing, out: Path) -> None:
    """Write a PNG file with the views of photos, two photos per row.

    Args:
        photos: The photos, at least one.
        settings: Preprocessing that makes the views.
        out: File to write.

    Raises:
        ImageError: A photo cannot be read.
    """
    views = [np.rint(255 * settings.load_photo(path)).astype(np.uint8) for path in photos]
    blanks = [np.full_like(views[0], 255)] * (-len(views) % COLUMNS)
    sheet = np.concatenate([*views, *blanks]).reshape(-1, COLUMNS, *views[0].shape)
    sheet = np.vstack([np.hstack(list(row)) for row in sheet])
    write_output(out, cv2.imencode(".png", sheet[..., ::-1])[1].tobytes())
