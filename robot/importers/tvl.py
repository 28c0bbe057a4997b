"""TVL, the part HCT: DIGIT touches and photos from hand-held devices, outdoors and indoors, with captions.

    hct/data1|data2|data3/
        train.csv  test.csv  contact.json  not_contact.json
        <k>-<time>/tactile/<frame>.jpg  vision/<frame>.jpg        the same name is the same moment
        <k>-<time>/tactile_bg_latent.jpg                          the no-contact frame of this folder

A timestamp folder is one contact with one thing: object and sequence, `<data>-<k>-<time>`. Its frames are those in
contact.json; without this file, all in `tactile`. A frame in not_contact.json, such as one with the gel in the air, is
not a grasp.
"""

import csv
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from robot.errors import ImporterError
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    DataSetMetadata,
    Images,
    Item,
    Progress,
    Skip,
    import_items,
    safe_name,
    subfolders,
)
from robot.importers.row_splits import RowSplit
from robot.recording.folder import Recording, SharedImage

CITATION = (
    "Fu, Datta, Huang, Panitch, Drake, Ortiz, Mukadam, Lambeta, Calandra, Goldberg, A Touch, Vision, and Language "
    "Dataset for Multimodal Alignment, ICML 2024"
)
TERMS = "see the data set's card on Hugging Face (mlfu7/Touch-Vision-Language-Dataset)"
DATA_SET = DataSet(
    source="tactile-vlm.github.io, HCT",
    licence=NOT_STATED,
    terms=TERMS,
    citation=CITATION,
    sensor="DIGIT",
    rig="by hand, webcam next to the sensor",
    expects="`hct/data1/<k>-<time>/{tactile,vision}/<frame>.jpg`, or be the folder `hct` itself",
    background="one frame per contact",
    caveats=(
        "Frames of one timestamp folder are neighbours in a video, and the authors drew validation rows from the "
        "training rows frame by frame: the nearest neighbour by raw pixels identifies the folder. Here a folder is one "
        "object and one sequence, so a split by object does not divide it.",
        "In the first upload `tactile` and `vision` were exchanged in some folders: `retrieve check` lists them.",
        "The photo shows the moment of the touch, with the sensor.",
    ),
    unverified=(
        "sizes of the photos",
        "that the paths in contact.json and in the CSV files are relative to their own folder",
    ),
)
_MAX_JSON_BYTES = 256 * 2**20


def import_tvl(src: Path, out: Path, progress: Progress | None = None) -> Recording:
    """Import the contacts below `src`.

    Raises:
        ImporterError: There is no contact.
    """
    root = Path(src) / "hct" if (Path(src) / "hct").is_dir() else Path(src)
    parts = [part for part in (subfolders(root) if root.is_dir() else []) if part.name.startswith("data")]
    contacts = [contact for part in parts for contact in subfolders(part) if (contact / "tactile").is_dir()]
    if not contacts:
        raise DATA_SET.mismatch_error(Path(src), "no folder with tactile/ was found")
    split, objects = RowSplit("published"), dict[str, dict[str, Any]]()
    known = {_name(contact) for contact in contacts}
    for part in parts:
        for side in ("train", "test"):
            for row in csv_rows(part / f"{side}.csv"):
                object_id = f"{part.name}-{(row.get('url') or '').split('/')[0]}"
                if object_id in known:
                    split.add(side, object_id, object_id)
                    objects.setdefault(object_id, {"caption": row.get("caption")})
    splits, leaks = split.object_splits()
    contact_frames = _ContactFrames(parts)
    return import_items(
        replace(DATA_SET, caveats=(*DATA_SET.caveats, *leaks)),
        _items(contacts, contact_frames),
        out,
        total=sum(len(contact_frames.frames(contact)) for contact in contacts),
        progress=progress,
        metadata=DataSetMetadata(objects, splits),
    )


def _name(contact: Path) -> str:
    return f"{contact.parent.name}-{contact.name}"


def _items(contacts: list[Path], contact_frames: "_ContactFrames") -> Iterator[Item | Skip]:
    for contact in contacts:
        background = contact / "tactile_bg_latent.jpg"
        no_contact = SharedImage(safe_name(contact.parent.name, contact.name, "no_contact"), background)
        for frame in contact_frames.frames(contact):
            images: Images = {"photo": contact / "vision" / frame, "touch_a": contact / "tactile" / frame}
            if background.is_file():
                images = {**images, "touch_a_before": no_contact}
            grasp_id = safe_name(contact.parent.name, contact.name, Path(frame).stem)
            yield Item(grasp_id, _name(contact), images, {"sequence_id": _name(contact)})


class _ContactFrames:
    """The frames in contact.json; without this file, all frames of a contact."""

    def __init__(self, parts: list[Path]) -> None:
        self._contact = {part: _read_frame_lists(part / "contact.json") for part in parts}
        self._other = {part: _read_frame_lists(part / "not_contact.json") or {} for part in parts}

    def frames(self, contact: Path) -> list[str]:
        """Return the file names of a contact, in order of their frame numbers."""
        listed = self._contact[contact.parent]
        found = {path.name for path in (contact / "tactile").iterdir() if path.suffix.lower() in (".jpg", ".png")}
        names = found if listed is None else listed.get(contact.name, set())
        return sorted(names - self._other[contact.parent].get(contact.name, set()), key=_number)


def _number(name: str) -> tuple[int, str]:
    head = name.split("-")[0]
    return (int(head) if head.isdecimal() and len(head) < 19 else -1, name)


def _read_frame_lists(path: Path) -> dict[str, set[str]] | None:
    """Read contact.json: folder -> names of its tactile files; None if the file is missing."""
    if not path.exists():
        return None
    try:
        with open(path, "rb") as file:
            found = json.loads(file.read(_MAX_JSON_BYTES))
    except (OSError, ValueError) as error:
        raise ImporterError(f"{path} cannot be read: {error}") from error
    tactile = found.get("tactile") if isinstance(found, dict) else None
    if not isinstance(tactile, list) or not all(isinstance(entry, str) for entry in tactile):
        raise ImporterError(f"{path} must contain lists of paths under vision, tactile and background")
    names: dict[str, set[str]] = {}
    for entry in tactile:
        folder, _, name = ["", "", *entry.split("/")][-3:]
        names.setdefault(folder, set()).add(name)
    return names


def csv_rows(path: Path) -> Iterator[dict[str, str | None]]:
    """Yield the rows of a CSV file with a header; none if the file is missing.

    Raises:
        ImporterError: The file cannot be read.
    """
    if not path.exists():
        return
    try:
        with open(path, encoding="utf-8", errors="replace", newline="") as file:
            for row in csv.DictReader(file, skipinitialspace=True):
                yield {str(key): value for key, value in row.items() if key is not None}
    except (OSError, csv.Error) as error:
        raise ImporterError(f"{path} cannot be read: {error}") from error
