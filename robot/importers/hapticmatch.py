"""HapticMatch: height maps of a GelSight Mini on surfaces of materials, each with a close photo of the same patch.

    Texture/<material>/<k>.jpg    the photo of the patch, 320 x 240
    Texture/<material>/<k>.pkl    the height map, a pickled NumPy array, read without unpickling

A material is an object and a sequence; a sample is a grasp. There is no gel image: the touch is a picture of the
normals of the height map. Red is the horizontal slope, green the vertical slope, blue the remaining component; a flat
surface is (128, 128, 255). Slopes assume heights in pixels; the option `scale` multiplies the heights.
"""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.errors import ImporterError
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Item,
    Progress,
    Skip,
    import_items,
    numbered_files,
    safe_name,
    subfolders,
)
from robot.importers.pickled_arrays import MAX_BYTES, read_array
from robot.recording.folder import Recording
from robot.storage import read_content

DATA_SET = DataSet(
    source="HapticMatch",
    licence=NOT_STATED,
    terms="its files state none; see github.com/MXMX0811/GelSight_Texture_Dataset",
    citation="Zhang, Yao, Makino, Shinoda, Sugiyama, HapticMatch: An Exploration for Generative Material Haptic "
    "Simulation and Interaction, arXiv 2601.16639",
    sensor="GelSight Mini, height maps",
    rig="by hand; a camera at the same patch",
    expects="`Texture/<material>/<k>.jpg` and `<k>.pkl`, or be the folder `Texture` itself",
    caveats=(
        "The touch is a picture of the normals of a height map, not a gel image: a model trained on gel images does "
        "not fit it.",
        "The samples of a material were captured in one session, and there is no no-contact frame: drift of the sensor "
        "may identify the material. Print the low-pass control and the order of capture next to every result.",
    ),
    unverified=(
        "everything except the file names and the authors' program that saved the files: this importer was not run on "
        "the real data",
        "the unit of the heights; slopes assume pixels",
        "that a photo and its height map show the same patch in the same direction",
    ),
)
_HEIGHTS = re.compile(r"(\d{1,9})\.pkl", re.IGNORECASE)
_MAX_SIDE = 4096


def import_hapticmatch(src: Path, out: Path, progress: Progress | None = None, *, scale: float = 1.0) -> Recording:
    """Import the samples below `src`.

    Args:
        src: Folder of the data set.
        out: Recording folder to write or continue.
        progress: Called with (done, total) after each grasp.
        scale: Factor of the heights.

    Raises:
        ImporterError: There is no sample, or `scale` is invalid.
    """
    src = Path(src)
    if not 0 < scale < float("inf"):
        raise ImporterError(f"scale must be above 0 and finite, got {scale:g}")
    root = src / "Texture" if (src / "Texture").is_dir() else src
    if not root.is_dir():
        raise DATA_SET.mismatch_error(src, "it is not a folder")
    materials = [(folder, numbered_files(folder, _HEIGHTS)) for folder in subfolders(root)]
    if not (total := sum(len(samples) for _, samples in materials)):
        raise DATA_SET.mismatch_error(src, "it contains no such height map")
    items = (item for folder, samples in materials for item in _items(folder.name, samples, scale))
    return import_items(DATA_SET, items, out, total=total, progress=progress)


def _items(material: str, samples: Any, scale: float) -> Iterator[Item | Skip]:
    sequence = safe_name(material)
    for match, path in samples:
        images = {"photo": path.with_name(f"{match[1]}.jpg"), "touch_a": partial(_touch, path, scale)}
        yield Item(safe_name(material, match[1]), material, images, {"sequence_id": sequence})


def _touch(path: Path, scale: float) -> NDArray[np.uint8]:
    """Return the picture of a height map. Errors do not name the file."""
    try:
        too_large = path.stat().st_size > MAX_BYTES
        data = b"" if too_large else read_content(path, ImporterError)
    except (OSError, ImporterError) as error:
        raise ImporterError("its height map cannot be read") from error
    if too_large:
        raise ImporterError(f"its height map has more than {MAX_BYTES:,} bytes")
    try:
        heights = read_array(data)
    except ImporterError as error:
        raise ImporterError(f"its height map cannot be read: {error}") from error
    return normals(heights, scale)


def normals(heights: NDArray[Any], scale: float = 1.0) -> NDArray[np.uint8]:
    """Return the normals of a height map as a picture.

    Args:
        heights: (H, W), in pixels.
        scale: Factor of the heights.

    Returns:
        (H, W, 3) uint8; red and green are 128 where the surface is flat.

    Raises:
        ImporterError: The shape is wrong, or heights are not finite.
    """
    if heights.ndim != 2 or min(heights.shape) < 2 or max(heights.shape) > _MAX_SIDE:
        raise ImporterError(f"its height map must have two sides of 2 to {_MAX_SIDE} pixels")
    if heights.dtype.kind not in "fiu" or not np.isfinite(heights).all():
        raise ImporterError("its height map must contain finite numbers")
    with np.errstate(over="ignore"):
        down, across = np.gradient(np.clip(heights.astype(np.float64), -1e12, 1e12) * scale)
    steep = np.sqrt(1 + down**2 + across**2)
    picture = np.stack([-across / steep, -down / steep, 1 / steep], axis=2)
    return np.clip(np.rint(127.5 * (picture + 1)), 0, 255).astype(np.uint8)
