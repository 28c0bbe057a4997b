"""RCT: full presses of three DIGITs on 122 industrial reference materials by a robot, with forces and photos.

    metadata/force_metadata.csv     material_id,position,sensor,z_frame,raw_fz: a row for each of 29,279 frames
    <touch>                         where its picture lies: the option `touch`, a path with the row's names in braces
    <photo>                         where the photo of its material lies: the option `photo`

The names of the picture folders were never seen: the options say where pictures lie, with `*` for what does not matter,
and what is not found is counted. A material is an object; a press (material, position, sensor) is a sequence, and a row
is a grasp. `sensor` takes the rows of one of the three sensors alone.
"""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from robot.errors import ImporterError
from robot.importers.importing import DataSet, DataSetMetadata, Item, Progress, Skip, import_items, safe_name
from robot.importers.tvl import csv_rows
from robot.recording.folder import Recording, SharedImage

DATA_SET = DataSet(
    source="RCT, arXiv 2606.31694",
    licence="as the data set's own page says",
    citation="RCT: A Robot-Collected Touch-Vision-Language Dataset for Tactile Generalization, arXiv 2606.31694",
    sensor="DIGIT",
    rig="robot arm, presses along z",
    expects="`metadata/force_metadata.csv` and the pictures that the options touch and photo name",
    caveats=(
        "Frames of one press are nearly alike, and its authors found 17.7 points of recall gone once presses no longer "
        "stood on both sides: split by material, which is the object here, or by sequence_id, never by frame.",
        "Three DIGITs took turns; a press names its sensor in its sequence_id. One sensor alone: --option sensor=...",
        "A photo is one of its material, not of the place that was pressed.",
    ),
    unverified=(
        "where the pictures lie and what they are called; the options touch and photo say it",
        "that raw_fz is in newton; its size is kept as force_n",
    ),
)
_COLUMNS = ("material_id", "position", "sensor", "z_frame")
_WORD = re.compile(r"[\w. +-]{1,80}")
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
    """Import the rows of force_metadata.csv. Raises ImporterError where it is not there, or names no picture."""
    src = Path(src)
    table = src / "metadata" / "force_metadata.csv"
    if not table.is_file():
        raise DATA_SET.mismatch_error(src, "it has no metadata/force_metadata.csv")
    for option, pattern in (("touch", touch), ("photo", photo)):
        if set(_FIELD.findall(pattern)) - set(_COLUMNS):
            raise ImporterError(f"braces of {option} may hold {', '.join(_COLUMNS)}, got {pattern!r}")
        if not pattern or pattern.startswith("/") or ".." in pattern:
            raise ImporterError(f"{option} must be a path below the data set's folder, got {pattern!r}")
    counts: Counter[str] = Counter()
    example = None
    for row in _rows(table, sensor):
        counts["rows"] += 1
        if isinstance(row, Skip):
            continue
        counts[row["material_id"]] += 1
        example = example or (row if _find(src, touch, row) and _find(src, photo, row) else None)
    if example is None:
        there = ", ".join(sorted(path.name for path in src.iterdir())[:8])
        raise DATA_SET.mismatch_error(
            src,
            f"no row has a picture at touch={touch} and a photo at photo={photo} (there are: {there}); say where they "
            "lie by --option touch=... photo=...",
        )
    total = counts.pop("rows")
    facts = DATA_SET if not sensor else replace(DATA_SET, sensor=f"DIGIT {sensor}")
    return import_items(
        facts,
        _items(src, table, touch, photo, sensor),
        out,
        total=total,
        progress=progress,
        metadata=DataSetMetadata({name: {"frames": count} for name, count in counts.items()}),
    )


def _rows(table: Path, sensor: str) -> Iterator[dict[str, str] | Skip]:
    """Rows of the wanted sensor, each with all columns. Raises ImporterError."""
    for number, row in enumerate(csv_rows(table), start=2):
        found = {key: (row.get(key) or "").strip() for key in (*_COLUMNS, "raw_fz")}
        if all(_WORD.fullmatch(found[key]) and found[key].strip(". ") for key in _COLUMNS):
            if not sensor or found["sensor"] == sensor:
                yield found
        else:
            yield Skip(f"a row of {table.name} lacks {', '.join(_COLUMNS)}, or has a strange name there", f"{number}")


def _items(src: Path, table: Path, touch: str, photo: str, sensor: str) -> Iterator[Item | Skip]:
    for row in _rows(table, sensor):
        if isinstance(row, Skip):
            yield row
            continue
        name = safe_name(*(row[key] for key in _COLUMNS))
        felt, seen = _find(src, touch, row), _find(src, photo, row)
        if felt is None or seen is None:
            yield Skip(f"no picture lies where the option {'touch' if felt is None else 'photo'} says", name)
            continue
        shared = SharedImage(safe_name("photo", row["material_id"]), seen)
        fields = {"sequence_id": "-".join(row[key] for key in _COLUMNS[:3])} | _force(row["raw_fz"])
        yield Item(name, row["material_id"], {"photo": shared, "touch_a": felt}, fields)


def _find(src: Path, pattern: str, row: dict[str, str]) -> Path | None:
    """The first file that the pattern names for a row; None where there is none. Raises ImporterError."""
    filled = _FIELD.sub(lambda place: row[place[1]], pattern)
    try:
        found = sorted(src.glob(filled))
    except (ValueError, IndexError) as error:  # of "a**b" and of "."
        raise ImporterError(f"a pattern must be a path with * in it, got {pattern!r}: {error}") from error
    return next((path for path in found if path.is_file()), None)


def _force(text: str) -> dict[str, float]:
    try:
        force = abs(float(text))
    except ValueError:
        return {}
    return {"force_n": force} if force < 1e6 else {}
