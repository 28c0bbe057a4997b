"""X-Capture: DIGIT-like touches, photos, depth and force at points of everyday objects, captured in the wild.

    <object>/<point>/<point>_rgb.png             the photo of the point
    <object>/<point>/<point>_10N_tactile.png     the touch, at 10 N
    <object>/<point>/<point>_depth.png           depth at the camera

An object is a folder, a point is a grasp; the points of an object are one sequence. The force of a touch comes from its
file name. The readings of force, acceleration and sound are not read. Depth is imported if it is a 16-bit picture.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from robot.errors import ImporterError
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Images,
    Item,
    Progress,
    Skip,
    import_items,
    numbered_files,
    safe_name,
    subfolders,
)
from robot.recording.folder import Recording
from robot.storage import decode_picture, read_content

DATA_SET = DataSet(
    source="X-Capture",
    licence=NOT_STATED,
    terms="see xcapture.github.io",
    citation="X-Capture: An Open-Source Portable Device for Multi-Sensory Learning, ICCV 2025",
    sensor="DIGIT-like",
    rig="by hand, a portable device",
    expects="`<object>/<point>/<point>_<force>N_tactile.png` and `<point>_rgb.png`",
    caveats=(
        "There is no no-contact frame, and an object was captured in one session: its light and gel may identify the "
        "object. Print the order of capture and the low-pass control next to every result.",
    ),
    unverified=(
        "everything except the file names of a few published example objects: this importer was not run on the "
        "real data",
        "that depth is in millimetres",
        "that the photo of a point was taken before its touch",
    ),
)
_TOUCH = re.compile(r"(?P<point>.+)_(?P<force>\d{1,3})N_tactile\.png", re.IGNORECASE)


def import_x_capture(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import the points below `src`.

    Raises:
        ImporterError: There is no point with a touch.
    """
    src = Path(src)
    if not src.is_dir():
        raise DATA_SET.mismatch_error(src, "it is not a folder")
    points = [point for folder in subfolders(src) for point in subfolders(folder) if len(numbered_files(point, _TOUCH))]
    if not points:
        raise DATA_SET.mismatch_error(src, "it contains no such touch")
    total = sum(len(numbered_files(point, _TOUCH)) for point in points)
    return import_items(DATA_SET, _items(points), out, total=total, progress=progress)


def _items(points: list[Path]) -> Iterator[Item | Skip]:
    for point in points:
        object_id = point.parent.name
        for match, touch in numbered_files(point, _TOUCH):
            name = safe_name(object_id, point.name, f"{match['force']}N")
            depth = _depth(point / f"{match['point']}_depth.png")
            images: Images = {"photo": point / f"{match['point']}_rgb.png", "touch_a": touch, **depth}
            yield Item(name, object_id, images, {"sequence_id": object_id, "force_n": float(match["force"])})


def _depth(path: Path) -> Images:
    """Return the depth picture if it has 16 bits and one channel. A grasp without depth is also imported."""
    import cv2

    if not path.is_file():
        return {}
    try:
        data = read_content(path, ImporterError)
    except ImporterError:
        return {}
    image = decode_picture(data, cv2.IMREAD_UNCHANGED)
    return {"depth": image} if image is not None and image.ndim == 2 and image.dtype == np.uint16 else {}
