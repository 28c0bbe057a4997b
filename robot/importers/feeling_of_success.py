"""The Feeling of Success: 9,269 grasps of a hundred everyday objects with two GelSights and a Kinect.

    calandra_corl2017_000.h5 ... calandra_corl2017_037.h5    250 grasps each (extra `importers`)
        /data/i0, /data/i1, ...                              groups with the attributes object_name, is_gripping
            kinectA_rgb_before, _during, _after              (H, W, 3) uint8
            gelsightA_before, _during, _after, gelsightB_... (H, W, 3) uint8

The photo is the Kinect picture before the grasp. "during" is after closing and before the lift; "before" and "after"
become the no-contact frame and the gel after the lift. `grasped` is the data set's `is_gripping`: training leaves
failed grasps out. Consecutive grasps of one object are a sequence. Nothing in the files is unpickled.
"""

import contextlib
import re
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy.typing as npt

from robot.errors import ImporterError
from robot.extras import import_extra
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    Images,
    Item,
    Progress,
    Skip,
    import_items,
    natural_sort_key,
    numbered_files,
)
from robot.recording.folder import Recording, safe_name

DATA_SET = DataSet(
    source="The Feeling of Success",
    licence=NOT_STATED,
    terms="its files state none; see its page, doi 10.25532/OPARA-700",
    citation="Calandra, Owens, Upadhyaya, Yuan, Lin, Adelson, Levine, The Feeling of Success: Does Touch Sensing Help "
    "Predict Grasp Outcomes?, CoRL 2017",
    sensor="GelSight",
    rig="Sawyer, Weiss WSG-50, Kinect 2",
    fingers=2,
    background="before each grasp",
    expects="`calandra_corl2017_000.h5` to `calandra_corl2017_037.h5`, or some of them",
    caveats=(
        "The gels of 2017 carry black marks, which move with shear.",
        "Objects were grasped one after the other, so light and gel drift with the object: print the low-pass control "
        "next to every result.",
    ),
    unverified=(
        "the compression of the published files: blosc needs pip install hdf5plugin",
        "that the first colour is red",
        "that each object has one name: earlier files cut names off, so an object might have two",
    ),
)
_FILE = re.compile(r".*\.(h5|hdf5)")
_GRASP = re.compile(r"i(\d+)")
_COLUMNS = {
    "photo": "kinectA_rgb_before",
    **{f"touch_{finger}": f"gelsight{sensor}_during" for finger, sensor in (("a", "A"), ("b", "B"))},
    **{f"touch_{finger}_before": f"gelsight{sensor}_before" for finger, sensor in (("a", "A"), ("b", "B"))},
    **{f"touch_{finger}_after": f"gelsight{sensor}_after" for finger, sensor in (("a", "A"), ("b", "B"))},
}
_GRIPPING = {0: False, 1: True}
_BROKEN = (OSError, KeyError, ValueError, RuntimeError, TypeError)
"""Errors that h5py raises for damaged files."""


def import_feeling_of_success(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import the HDF5 files in `src`.

    Raises:
        ImporterError: `src` contains no HDF5 file, or h5py is missing.
    """
    files = [path for _, path in numbered_files(src, _FILE)]
    if not files:
        raise DATA_SET.mismatch_error(src, "it contains no HDF5 file")
    h5py = import_extra("h5py", "The Feeling of Success")
    with contextlib.suppress(ImportError):
        import_module("hdf5plugin")  # registers its filters
    total = sum(_count(h5py, path) for path in files)
    return import_items(DATA_SET, _items(h5py, files), out, total=total, progress=progress, source=src)


def _count(h5py: Any, path: Path) -> int:
    try:
        with h5py.File(path) as file:
            return len(file["data"])
    except _BROKEN:
        return 1


def _items(h5py: Any, files: list[Path]) -> Iterator[Item | Skip]:
    last_object, run = "", 0
    for path in files:
        with contextlib.ExitStack() as stack:
            try:
                data = stack.enter_context(h5py.File(path)).get("data")
                names = sorted(filter(_GRASP.fullmatch, data or ()), key=natural_sort_key)
            except _BROKEN:
                yield Skip("its file is not HDF5 or is cut off", path.name)
                continue
            if data is None:
                yield Skip("its file has no /data; it may be of another version", path.name)
            for key in names:
                name = safe_name(path.stem, key)
                try:
                    group = data[key]
                    object_id, grasped = _text(group.attrs["object_name"]), _GRIPPING[group.attrs["is_gripping"]]
                except (*_BROKEN, AttributeError):
                    object_id, grasped = "", False
                if not object_id:
                    yield Skip("its object_name or is_gripping is missing", name)
                    continue
                if object_id != last_object:
                    last_object, run = object_id, run + 1
                images: Images = {column: partial(_read, h5py, group, dataset) for column, dataset in _COLUMNS.items()}
                yield Item(name, object_id, images, {"grasped": grasped, "sequence_id": f"{object_id}-{run}"})


def _text(name: Any) -> str:
    return (name.decode(errors="replace") if isinstance(name, bytes) else str(name)).strip()


def _read(h5py: Any, group: Any, name: str) -> npt.NDArray[Any]:
    """Return a picture; raise ImporterError without the name of the file."""
    try:
        if not isinstance(dataset := group.get(name), h5py.Dataset):
            raise ImporterError(f"its {name} is missing")
        if dataset.dtype != "uint8" or dataset.ndim != 3 or dataset.shape[2] != 3:
            raise ImporterError(f"its {name} is not a picture with 8-bit colours")
        return dataset[()]  # type: ignore[no-any-return]
    except _BROKEN as error:
        raise ImporterError(f"its {name} cannot be read; blosc needs pip install hdf5plugin") from error
