"""A contact sheet of a recording: photo, depth, and the gels before and during the grasp."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from _touch_retrieval.files import write_atomically
from robot.errors import RecordingError
from robot.recording.folder import read_recording
from robot.recording.grasp import RecordedGrasp
from robot.storage import decode_picture, storage_errors

Picture = npt.NDArray[np.uint8]
MAX_ROWS, TILE_PX, _CAPTION_PX = 12, 160, 24


def write_preview(folder: str | Path, out: str | Path) -> Path:
    """Write a PNG with one grasp of each of up to `MAX_ROWS` objects of a recording, evenly chosen; return its path.

    Raises:
        RecordingError: The recording is invalid or empty.
        StorageError: The file cannot be written.
    """
    recording, out = read_recording(folder), Path(out)
    first: dict[str, RecordedGrasp] = {}
    for grasp in sorted(recording.grasps, key=lambda grasp: grasp.grasped is False):  # accepted ones first
        first.setdefault(grasp.object_id, grasp)
    if not first:
        raise RecordingError("a preview needs a recording with at least one grasp; this one has none")
    picked = np.linspace(0, len(first) - 1, min(MAX_ROWS, len(first))).round().astype(int)
    grasps = [list(first.values())[index] for index in picked]
    columns = list(dict.fromkeys(column for grasp in grasps for column in grasp.images() if "after" not in column))
    header = np.hstack([_caption(column, TILE_PX) for column in columns])
    sheet = np.vstack([header, *(_row(recording.folder, grasp, columns) for grasp in grasps)])
    with storage_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, cv2.imencode(".png", sheet)[1].tobytes())
    return out


def _row(folder: Path, grasp: RecordedGrasp, columns: Sequence[str]) -> Picture:
    """Return the tiles of one grasp, BGR, with its name and force below."""
    images = grasp.images()
    row = np.hstack([_tile(folder / images[column] if column in images else None, column) for column in columns])
    text = f"{grasp.object_id}   {grasp.force_n or 0:.1f} N   jaws {grasp.opening_mm or 0:.1f} mm"
    return np.vstack([row, _caption(f"{text}   {grasp.outcome or ''}", row.shape[1])])


def _tile(path: Path | None, column: str) -> Picture:
    """Fit an image into a square tile, depth as colours over its own range; without an image the tile is grey."""
    tile = np.full((TILE_PX, TILE_PX, 3), 238, np.uint8)
    if path is None or not path.is_file():
        return tile
    depth = column == "depth"
    image = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH) if depth else decode_picture(path.read_bytes())
    if image is None:
        return tile
    if depth:
        level = cv2.normalize(image, np.empty(0), 255, 0, cv2.NORM_MINMAX, cv2.CV_8U, (image > 0).astype(np.uint8))
        image = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS) * (image > 0)[..., None]
    else:
        image = np.ascontiguousarray(image[..., ::-1])
    height, width = (round(side * (TILE_PX - 4) / max(image.shape[:2])) for side in image.shape[:2])
    top, left = (TILE_PX - height) // 2, (TILE_PX - width) // 2
    tile[top : top + height, left : left + width] = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return tile


def _caption(text: str, width: int) -> Picture:
    strip = np.full((_CAPTION_PX, width, 3), 255, np.uint8)
    return np.asarray(cv2.putText(strip, text, (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (30, 30, 30), 1, cv2.LINE_AA))
