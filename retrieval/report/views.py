"""A contact sheet of what the matcher sees of a catalogue's photos: a row for each, its views side by side."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from retrieval.console.files import GENERATOR, PREVIEW, write_output
from retrieval.data.preprocessing import Preprocessing

COLUMNS = 2


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
