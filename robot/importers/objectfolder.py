"""ObjectFolder: samples of ObjectFolder Real, and the packs of its cross-sensory retrieval benchmark.

    <index>/visual/0.png  <index>/tactile/0.png     samples of Real, index 1 to 100 of the public list

    vision/<object>/<instance>.png                  a pack of the benchmark, real or simulated
    touch/<object>/<instance>.png
    split.json                                      {"train": {"<object>": [instances]}, "val": ..., "test": ...}

An object is its number: names occur twice in the public list. Where `objectfolder_real_metadata.csv` (Index, Name,
Material) lies beside the folders, names and materials stand in recording.json under `objects`. A touch is written
with the photo of its own number; where there is none, touches are dealt to the photos of their object in turn. The
split of a pack is kept where it parts objects. Audio is passed over.
"""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from robot.errors import ImporterError
from robot.importers.importing import (
    DataSet,
    DataSetMetadata,
    Item,
    Progress,
    Skip,
    import_items,
    numbered_files,
    safe_name,
    subfolders,
)
from robot.recording.folder import Recording, SharedImage
from robot.storage import read_content, read_json_object

DATA_SET = DataSet(
    source="ObjectFolder",
    licence="CC BY 4.0 (ObjectFolder 2.0; for Real see its page)",
    citation="Gao, Dou, Li and others, The ObjectFolder Benchmark: Multisensory Learning with Neural and Real Objects, "
    "CVPR 2023",
    sensor="GelSight",
    rig="robot arm; photos of the object alone",
    expects="`<index>/visual/0.png` and `<index>/tactile/0.png`, or `vision/<object>/` and `touch/<object>/`",
    caveats=(
        "In the benchmark a query counts as right when any picture of its object is found (mAP), and some published "
        "numbers on real objects are on objects that were trained on.",
    ),
    unverified=(
        "that a picture of the simulated packs is 160 pixels wide, by which they are told from the real ones",
        "whether the split of each pack parts objects or their pictures",
    ),
)
_SIMULATED = "GelSight, simulated (Taxim)"
_SIMULATED_WIDTH = 160
_PICTURE = re.compile(r"(\d+)\.(png|jpg)")
_NAMES = "objectfolder_real_metadata.csv"
_PARTS = {"train": "train", "val": "validation", "test": "test"}


def import_objectfolder(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import the samples or the pack in `src`. Raises ImporterError where it is neither."""
    src = Path(src)
    if not src.is_dir():
        raise DATA_SET.mismatch_error(src, "it is no folder")
    is_pack = (src / "vision").is_dir() and (src / "touch").is_dir()
    if is_pack:
        objects = [(each.name, each, src / "vision" / each.name) for each in subfolders(src / "touch")]
    else:
        objects = [(each.name, each / "tactile", each / "visual") for each in subfolders(src)]
    objects = [each for each in objects if each[0].isdecimal() and each[1].is_dir()]
    touched = [touch for _, touch, _ in objects for _, touch in islice(numbered_files(touch, _PICTURE), 1)]
    if not touched:
        raw = any((each / "tactile_data").is_dir() for each in subfolders(src))
        raise DATA_SET.mismatch_error(
            src, "it holds raw videos, without photos" if raw else "it holds no touch of that kind"
        )
    facts = replace(DATA_SET, sensor=_SIMULATED) if _width(touched[0]) == _SIMULATED_WIDTH else DATA_SET
    about = _names(src / _NAMES)
    metadata = DataSetMetadata(
        {name: about.get(name, {}) for name, _, _ in objects}, _split(src / "split.json") if is_pack else {}
    )
    total = sum(len(numbered_files(touch, _PICTURE)) for _, touch, _ in objects)
    return import_items(facts, _items(objects), out, total=total, progress=progress, metadata=metadata)


def _items(objects: Sequence[tuple[str, Path, Path]]) -> Iterator[Item | Skip]:
    for name, touch, vision in objects:
        photos = {match[1]: path for match, path in numbered_files(vision, _PICTURE)}
        for number, (match, path) in enumerate(numbered_files(touch, _PICTURE)):
            if not photos:
                yield Skip("its object has no photo", safe_name(name, match[1]))
                continue
            photo = photos.get(match[1]) or list(photos.values())[number % len(photos)]
            shared = SharedImage(safe_name(name, "photo", photo.stem), photo)
            yield Item(safe_name(name, match[1]), name, {"photo": shared, "touch_a": path})


def _width(path: Path) -> int:
    """Of a PNG, by its header; 0 for another file."""
    with open(path, "rb") as file:
        head = file.read(24)
    return int.from_bytes(head[16:20], "big") if head[12:16] == b"IHDR" else 0


def _names(path: Path) -> Mapping[str, Mapping[str, Any]]:
    """Name and material of each object, where the table is there."""
    if not path.is_file():
        return {}
    try:
        rows = csv.DictReader(read_content(path, ImporterError).decode("utf-8-sig").splitlines())
        return {
            str(row["Index"]).strip(): {"name": row["Name"], "material": row["Material"]}
            for row in rows
            if row.get("Index")
        }
    except (csv.Error, KeyError, UnicodeDecodeError) as error:
        raise ImporterError(f"{path} must be CSV with the columns Index, Name, Material: {error}") from error


def _split(path: Path) -> Mapping[str, Mapping[str, Sequence[str]]]:
    """The objects of each part: of {"<object>": [instances]}, or of [["<object>", instance], ...]."""
    if not path.is_file():
        return {}
    document = read_json_object(path, ImporterError)
    parts: dict[str, list[str]] = {}
    for theirs, ours in _PARTS.items():
        listed = document.get(theirs, {})
        if not isinstance(listed, dict | list):
            raise ImporterError(f"{path} must list objects under {theirs!r}, got {str(listed)[:40]}")
        names = listed if isinstance(listed, dict) else [row[0] for row in listed if isinstance(row, list) and row]
        parts[ours] = sorted({str(name) for name in names})
    return {"published": parts}
