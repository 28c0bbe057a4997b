"""Hugging Face's imagefolder: `datasets.load_dataset("imagefolder", data_dir=OUT)`.

    README.md                     a data set card: source, sensor, licence, citation
    <part>/metadata.jsonl         a line per grasp; <part> is train, or train, validation and test of the split
    <part>/images/...             the recording's own files, byte for byte

The columns are those of the recording: photo, touch_a, touch_a_before, ... are pictures; object_id and the others are
as recorded.
"""

import json
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path

from robot.errors import RecordingError
from robot.exporters.exporting import Parts, RecordingExport, atomic_folder, grasps_by_part, read_picture
from robot.importers.importing import Progress
from robot.recording.folder import METADATA_FILE, RecordedGrasp, Recording
from robot.storage import read_content


def export_imagefolder(
    recording: Recording, out: Path, *, parts: Parts | None = None, progress: Progress | None = None
) -> RecordingExport:
    """Write an imagefolder. Each picture is decoded once to detect damaged ones.

    Args:
        recording: The recording.
        out: New or empty folder.
        parts: Split of the objects; None for all in the training part.
        progress: Called with (done, total) after each grasp.

    Raises:
        RecordingError: A picture is damaged, or the split is invalid.
        StorageError: The folder cannot be written.
    """
    found, notes = grasps_by_part(recording, parts)
    columns, left_out = _common_columns(found.values())
    notes += [
        f"left out {name}, which some grasps do not have: `datasets` requires the same columns in all rows"
        for name in left_out
    ]
    total, done = sum(map(len, found.values())), 0
    with atomic_folder(out) as folder:
        (folder / "README.md").write_text(_card(recording), "utf-8")
        for part, grasps in found.items():
            (folder / part).mkdir()
            with open(folder / part / METADATA_FILE, "w", encoding="utf-8") as lines:
                for grasp in grasps:
                    lines.write(json.dumps(_line(recording, grasp, folder / part, columns), ensure_ascii=False) + "\n")
                    done += 1
                    if progress is not None:
                        progress(done, total)
    return RecordingExport(out, total, tuple(notes))


def _common_columns(parts: Collection[Sequence[RecordedGrasp]]) -> tuple[list[str], list[str]]:
    """Return the columns that `datasets` can read, and the other columns.

    A picture must exist for every grasp, another column for at least one grasp of each part.
    """
    counted = [(len(grasps), Counter(key for grasp in grasps for key in grasp.to_row())) for grasps in parts]
    keys = dict.fromkeys(key for _, counts in counted for key in counts)
    minimum = {key: [total if key.endswith("_file_name") else 1 for total, _ in counted] for key in keys}
    common = [
        key for key in keys if all(counts[key] >= n for n, (_, counts) in zip(minimum[key], counted, strict=True))
    ]
    return common, [key.removesuffix("_file_name") for key in keys if key not in common]


def _line(recording: Recording, grasp: RecordedGrasp, folder: Path, columns: Sequence[str]) -> dict[str, object]:
    """Copy the pictures of a grasp, each file once; return its line."""
    for column, relative in grasp.images().items():
        source, target = recording.folder / relative, folder / relative
        if f"{column}_file_name" in columns and not target.exists():
            if column != "depth":
                read_picture(source)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(read_content(source, RecordingError))
    row = grasp.to_row()
    return {key: row.get(key) for key in columns}


def _card(recording: Recording) -> str:
    facts = {
        key: recording.info[key]
        for key in ("source", "sensor", "rig", "background", "licence", "terms", "citation", "notes")
        if recording.info.get(key)
    }
    lines = [f"* {key}: {'; '.join(value) if isinstance(value, list) else value}" for key, value in facts.items()]
    return "# Touches and photos of the same objects\n\n" + "\n".join(lines) + "\n"
