"""Hugging Face's imagefolder: `datasets.load_dataset("imagefolder", data_dir=OUT)`.

    README.md                     a data set card: source, sensor, licence, citation
    <part>/metadata.jsonl         a line per grasp; <part> is train, or the split's train, validation, test
    <part>/images/...             the recording's own files, byte for byte

Columns are the recording's: photo, touch_a, touch_a_before, ... are pictures, object_id and the rest as recorded.
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
    """Write an imagefolder; every picture is decoded once, so that a broken one is refused here. Raises RecordingError,
    StorageError.
    """
    found, notes = grasps_by_part(recording, parts)
    columns, left_out = _common_columns(found.values())
    notes += [f"left out {name}, which grasps lack: `datasets` wants the same columns throughout" for name in left_out]
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
    """Keys of lines that `datasets` can read, and the others: a picture that every grasp has, and of the rest what
    grasps of every part have.
    """
    counted = [(len(grasps), Counter(key for grasp in grasps for key in grasp.to_row())) for grasps in parts]
    every = dict.fromkeys(key for _, counts in counted for key in counts)
    least = {key: [total if key.endswith("_file_name") else 1 for total, _ in counted] for key in every}
    kept = [key for key in every if all(counts[key] >= n for n, (_, counts) in zip(least[key], counted, strict=True))]
    return kept, [key.removesuffix("_file_name") for key in every if key not in kept]


def _line(recording: Recording, grasp: RecordedGrasp, folder: Path, columns: Sequence[str]) -> dict[str, object]:
    """Copy the grasp's pictures; return its line. A picture that several grasps share is copied once."""
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
    said = {
        key: recording.info[key]
        for key in ("source", "sensor", "rig", "background", "licence", "citation", "notes")
        if recording.info.get(key)
    }
    lines = [f"* {key}: {'; '.join(value) if isinstance(value, list) else value}" for key, value in said.items()]
    return "# Touches and photos of the same objects\n\n" + "\n".join(lines) + "\n"
