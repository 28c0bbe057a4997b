"""What pages are made of: the package's templates, thumbnails of image files, and images inside a page."""

import base64
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from retrieval.data.images import read_rgb
from retrieval.data.resize import resize
from retrieval.errors import ImageError

Thumbnail = NDArray[np.uint8]
"""(H, W, 3) red first."""


def render(name: str, **values: Any) -> str:
    """The template `name` with these values, whose text is escaped."""
    source = (resources.files("retrieval") / "templates" / name).read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(source).render(**values)


def script(name: str) -> Markup:
    """A script of the package, to stand inside a page."""
    return Markup((resources.files("retrieval") / "templates" / name).read_text("utf-8"))


def thumbnail(path: Path, px: int) -> Thumbnail | None:
    """The image at `path`, its longer side at most `px`; None where it cannot be read."""
    try:
        image = read_rgb(path)
    except ImageError:
        return None
    height, width = image.shape[:2]
    scale = min(1.0, px / max(height, width))
    image = resize(image, (max(1, round(height * scale)), max(1, round(width * scale))))
    return np.rint(image * 255).astype(np.uint8)


def jpeg(image: Thumbnail) -> bytes:
    """The image as the bytes of a JPEG file."""
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    return data.tobytes()


def data_uri(data: bytes, kind: str) -> str:
    """The bytes of an image file as an address that needs no file; kind is "jpeg" or "png"."""
    return f"data:image/{kind};base64," + base64.b64encode(data).decode("ascii")
