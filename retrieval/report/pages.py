"""What pages are made of: the package's templates, thumbnails of image files, images inside a page; and contact sheets
of what the matcher sees of a catalogue's photos.
"""

import base64
import io
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from retrieval.console.files import GENERATOR, PREVIEW, write_output
from retrieval.data.images import read_rgb
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import resize
from retrieval.errors import ImageError

ThumbnailPixels = NDArray[np.uint8]
"""(H, W, 3) red first."""
COLUMNS = 2
"""Photos of a contact sheet side by side."""


def render(name: str, **values: Any) -> str:
    """The template `name` with these values, whose text is escaped."""
    source = (resources.files("retrieval") / "templates" / name).read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(source).render(**values)


def script(name: str) -> Markup:
    """A script of the package, to stand inside a page."""
    return Markup((resources.files("retrieval") / "templates" / name).read_text("utf-8"))


def thumbnail(path: Path, px: int) -> ThumbnailPixels | None:
    """The image at `path`, its longer side at most `px`; None where it cannot be read."""
    try:
        image = read_rgb(path)
    except ImageError:
        return None
    height, width = image.shape[:2]
    scale = min(1.0, px / max(height, width))
    image = resize(image, (max(1, round(height * scale)), max(1, round(width * scale))))
    return np.rint(image * 255).astype(np.uint8)


def jpeg(image: ThumbnailPixels) -> bytes:
    """The image as the bytes of a JPEG file."""
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    return data.tobytes()


def data_uri(data: bytes, kind: str) -> str:
    """The bytes of an image file as an address that needs no file; kind is "jpeg" or "png"."""
    return f"data:image/{kind};base64," + base64.b64encode(data).decode("ascii")


def write_views(photos: Sequence[Path], settings: Preprocessing, out: Path) -> None:
    """Write a PNG with the views of photos, one at least, two to a row. Raises ImageError, BadInput."""
    strips = [np.rint(255 * settings.load_photo(path)).astype(np.uint8) for path in photos]
    height, width = strips[0].shape[:2]
    columns = min(COLUMNS, len(strips))
    sheet = Image.new("RGB", (columns * width, -(-len(strips) // columns) * height), "white")
    for place, strip in enumerate(strips):
        sheet.paste(Image.fromarray(strip), (place % columns * width, place // columns * height))
    made_by, content = PngInfo(), io.BytesIO()
    made_by.add_text("Software", GENERATOR)
    sheet.save(content, "PNG", pnginfo=made_by)
    write_output(out, content.getvalue(), PREVIEW)
