"""A contact sheet of a recording: photo, depth, and the gels before and during the grasp."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from _touch_retrieval.files import write_atomically
from robot.errors import RecordingError
from robot.recording.folder import RecordedGrasp, read_recording
from robot.storage import file_content, storage_errors

Picture = npt.NDArray[np.uint8]
TILE_PX = 160
_HEADER_PX = 24
_CAPTION_PX = 20


def write_preview(folder: str | Path, out: str | Path, rows: int = 12) -> Path:
    """Write a PNG with one grasp of each of up to `rows` objects of a recording, evenly chosen.

    Args:
        folder: the recording.
        out: the PNG file to write.
        rows: maximum number of objects.

    Returns:
        The path of the PNG file.

    Raises:
        RecordingError: The recording is invalid or empty.
        StorageError: The file cannot be written.
    """
    recording = read_recording(folder)
    chosen = _pick_grasps(recording.grasps, rows)
    fingers = sorted({finger for grasp in chosen for finger in grasp.touches})
    titles = ["photo", "depth", *(f"gel {finger} {moment}" for finger in fingers for moment in ("before", "during"))]
    header = np.hstack([_caption(title, TILE_PX, _HEADER_PX) for title in titles])
    sheet = np.vstack([header, *(_row(recording.folder, grasp, fingers) for grasp in chosen)])
    data, _ = file_content("preview", sheet)
    with storage_errors(Path(out)):
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(Path(out), data)
    return Path(out)


def _pick_grasps(grasps: Sequence[RecordedGrasp], rows: int) -> list[RecordedGrasp]:
    """Return the first accepted grasp of each of up to `rows` objects, or the first grasp if none was accepted."""
    accepted = [grasp for grasp in grasps if grasp.grasped is not False] or list(grasps)
    first: dict[str, RecordedGrasp] = {}
    for grasp in accepted:
        first.setdefault(grasp.object_id, grasp)
    names = list(first)
    if not names:
        raise RecordingError("a preview needs a recording with at least one grasp; this one has none")
    picked = np.linspace(0, len(names) - 1, min(rows, len(names))).round().astype(int)
    return [first[names[index]] for index in picked]


def _row(folder: Path, grasp: RecordedGrasp, fingers: Sequence[str]) -> Picture:
    """Return the tiles of one grasp, with its name and force below."""
    tiles = [_tile(_read(folder, grasp.photo)), _tile(_depth(folder, grasp))]
    for finger in fingers:
        tiles += [_tile(_read(folder, images.get(finger))) for images in (grasp.touches_before, grasp.touches)]
    row = np.hstack(tiles)
    text = (
        f"{grasp.object_id}   {grasp.force_n or 0:.1f} N   jaws {grasp.opening_mm or 0:.1f} mm   {grasp.outcome or ''}"
    )
    return np.vstack([row, _caption(text, row.shape[1], _CAPTION_PX)])


def _read(folder: Path, path: str | None) -> Picture | None:
    """Return the RGB pixels of an image of the recording; None if it was not recorded."""
    image = None if path is None else cv2.imread(str(folder / path), cv2.IMREAD_COLOR)
    return None if image is None else np.asarray(image[..., ::-1], np.uint8)


def _depth(folder: Path, grasp: RecordedGrasp) -> Picture | None:
    """Return the depth image as colours over its own range; holes are black."""
    if grasp.depth is None:
        return None
    image = cv2.imread(str(folder / grasp.depth), cv2.IMREAD_UNCHANGED)
    if image is None or not image.any():
        return None
    depth = image.astype(np.float64)
    known = depth > 0
    near, far = depth[known].min(), depth[known].max()
    level = 255 * (1 - np.clip((depth - near) / max(far - near, 1.0), 0, 1))
    colours = cv2.applyColorMap(level.astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(known[..., None], colours, 0).astype(np.uint8)


def _tile(image: Picture | None) -> Picture:
    """Fit the image into a square tile; without an image the tile is grey."""
    tile = np.full((TILE_PX, TILE_PX, 3), 238, np.uint8)
    if image is not None:
        scale = (TILE_PX - 4) / max(image.shape[:2])
        size = round(image.shape[1] * scale), round(image.shape[0] * scale)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        top, left = (TILE_PX - size[1]) // 2, (TILE_PX - size[0]) // 2
        tile[top : top + size[1], left : left + size[0]] = small
    return tile


def _caption(text: str, width: int, height: int) -> Picture:
    strip = np.full((height, width, 3), 255, np.uint8)
    return np.asarray(
        cv2.putText(strip, text, (4, height - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (30, 30, 30), 1, cv2.LINE_AA)
    )
