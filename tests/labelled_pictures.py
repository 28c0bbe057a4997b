"""Labelled pictures from a recording: each object has its own relief label, so its touches pair with its photos."""

import json
import os
from pathlib import Path

from retrieval.data.dataset import load_grasps


def label_recording(recording: Path, out: Path) -> dict[str, str]:
    """Write the folders photos and touches under `out` from the first grasp of each object.

    Returns:
        The folders as settings of a training.
    """
    first = {grasp.object_id: grasp for grasp in reversed(load_grasps(recording))}
    rows: dict[str, list[dict[str, object]]] = {"photos": [], "touches": []}
    for name, grasp in first.items():
        sizes = {"pitch_mm": 3.0, "amplitude_mm": 1.0, "aspect": 1.0, "sharpness": 0.5}
        row = {"object_id": name, "relief": name, "shape": "drawn", **sizes}
        rows["photos"].append({**row, "file_name": _from(out / "photos", grasp.photo)})
        for finger, touch, before in zip("ab", grasp.touches, grasp.backgrounds, strict=True):
            files = {"file_name": touch, "before_file_name": before}
            relative = {key: _from(out / "touches", path) for key, path in files.items()}
            rows["touches"].append({**row, "finger": finger, **relative})
    for kind, name in (("photo", "photos"), ("touch", "touches")):
        (out / name).mkdir(parents=True)
        (out / name / "pictures.json").write_text(json.dumps({"kind": kind}))
        (out / name / "metadata.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows[name]))
    return {name: str(out / name) for name in rows}


def _from(folder: Path, file: Path) -> str:
    return os.path.relpath(file, folder)
