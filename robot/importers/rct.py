"""RCT: full presses of three DIGITs on 122 industrial reference materials by a robot, with forces and photos.

    metadata/force_metadata.csv     material_id,position,sensor,z_frame,raw_fz: a row for each of 29,279 frames
    <touch>                         its picture: the option `touch`, a path with names of columns in braces
    <photo>                         the photo of its material: the option `photo`

The names of the picture folders are not verified: the options define the paths of pictures, with `*` for any text.
Missing pictures are counted. A material is an object; a press (material, position, sensor) is a sequence, and a row is
a grasp. `sensor` selects the rows of one of the three sensors.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from _touch_retrieval.text import read_table
from robot.errors import ImporterError
from robot.importers.importing import NOT_STATED, DataSet, Item, Progress, Skip, import_items
from robot.recording.folder import Recording, SharedImage, safe_name
from robot.storage import read_content

DATA_SET = DataSet(
    source="RCT, arXiv 2606.31694",
    licence=NOT_STATED,
    terms="see the data set's own page",
    citation="RCT: A Robot-Collected Touch-Vision-Language Dataset for Tactile Generalization, arXiv 2606.31694",
    sensor="DIGIT",
    rig="robot arm, presses along z",
    expects="`metadata/force_metadata.csv` and the pictures that the options touch and photo name",
    caveats=(
        "Frames of one press are nearly the same. The authors lost 17.7 points of recall when they kept each press in "
        "one part of the split. Split by material, which is the object here, or by sequence_id, never by frame.",
        "Three DIGITs took turns; the sequence_id of a press names its sensor. For one sensor: --option sensor=NAME",
        "A photo shows its material, not the place of the touch.",
    ),
    unverified=(
        "folders and names of the pictures; the options touch and photo define them",
        "that raw_fz is in newton; its absolute value is stored as force_n",
    ),
)
_COLUMNS = ("material_id", "position", "sensor", "z_frame")
_FIELD = re.compile(r"\{(\w*)\}")


def import_rct(
    src: Path,
    out: Path,
    progress: Progress | None = None,
    *,
    touch: str = "tactile/{material_id}/{position}/{sensor}/{z_frame}.*",
    photo: str = "rgb/{material_id}.*",
    sensor: str = "",
) -> Recording:
    """Import the rows of force_metadata.csv.

    Raises:
        ImporterError: The table is missing, or no row has its pictures.
    """
    table = src / "metadata" / "force_metadata.csv"
    if not table.is_file():
        raise DATA_SET.mismatch_error(src, "it has no metadata/force_metadata.csv")
    for option, pattern in (("touch", touch), ("photo", photo)):
        if set(_FIELD.findall(pattern)) - set(_COLUMNS):
            raise ImporterError(f"braces of {option} must contain one of {', '.join(_COLUMNS)}, got {pattern!r}")
    try:
        forces = read_table(read_content(table, ImporterError), _COLUMNS)
    except ValueError as error:
        raise ImporterError(f"{table}: {error}") from error
    rows = [row for _, row in forces.rows if sensor in ("", row["sensor"])]
    if not any(_find(src, touch, row) and _find(src, photo, row) for row in rows):
        content = ", ".join(sorted(path.name for path in src.iterdir())[:8])
        raise DATA_SET.mismatch_error(
            src,
            f"no row has a picture at touch={touch} and a photo at photo={photo} (the folder contains: {content}); set "
            "the paths with --option touch=... photo=...",
        )
    facts = DATA_SET if not sensor else replace(DATA_SET, sensor=f"DIGIT {sensor}")
    counts = Counter(row["material_id"] for row in rows)
    return import_items(
        facts,
        _items(src, rows, touch, photo, forces.number),
        out,
        total=len(rows),
        progress=progress,
        source=src,
        options={"touch": touch, "photo": photo, "sensor": sensor},
        objects={name: {"frames": count} for name, count in counts.items()},
    )


def _items(
    src: Path, rows: Sequence[dict[str, str]], touch: str, photo: str, number: Callable[[str], float]
) -> Iterator[Item | Skip]:
    for row in rows:
        name = safe_name(*(row[key] for key in _COLUMNS))
        touch_file, photo_file = _find(src, touch, row), _find(src, photo, row)
        if touch_file is None or photo_file is None:
            yield Skip(f"no picture matches the option {'touch' if touch_file is None else 'photo'}", name)
            continue
        shared = SharedImage(safe_name("photo", row["material_id"]), photo_file)
        fields = {"sequence_id": "-".join(row[key] for key in _COLUMNS[:3])} | _force(row.get("raw_fz", ""), number)
        yield Item(name, row["material_id"], {"photo": shared, "touch_a": touch_file}, fields)


def _find(src: Path, pattern: str, row: dict[str, str]) -> Path | None:
    """Return the first file that the pattern matches for a row; None without one."""
    filled = _FIELD.sub(lambda field: row[field[1]], pattern)
    try:
        found = sorted(src.glob(filled))
    except (ValueError, IndexError, NotImplementedError) as error:  # for "a**b", "." and "/a"
        raise ImporterError(f"a pattern must be a path that may contain *, got {pattern!r}: {error}") from error
    return next((path for path in found if path.is_file()), None)


def _force(text: str, number: Callable[[str], float]) -> dict[str, float]:
    try:
        force = abs(number(text))
    except ValueError:
        return {}
    return {"force_n": force} if force < 1e6 else {}
