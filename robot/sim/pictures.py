"""Labelled pictures of simulated objects, for training on relief: photos and touches need no pairs.

    pictures.json     schema_version, kind ("photo" or "touch"), source, sensor, seed, objects, software_version
    metadata.jsonl    one line per picture: file_name, object_id, and the object's labels
                      (`robot.sim.objects.draw.SimObject.labels`); touches also have finger and before_file_name,
                      the no-contact frame
    images/           PNG files; the folder opens as is with Hugging Face datasets ("imagefolder")

A photographed object takes a tenth of the time of a full grasp, and a press a third. An object's lines are written when
its pictures are on disk; an interrupted run continues where it stopped.
"""

import functools
import json
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from _touch_retrieval.files import write_atomically
from robot.errors import RecordingError, RobotConfigError
from robot.recording.folder import IMAGES_FOLDER, METADATA_FILE, software_version
from robot.rig import load_rig
from robot.sim.rig import SimRig
from robot.storage import (
    append_line,
    file_content,
    read_content,
    read_json_object,
    storage_errors,
    sync_threads,
    write_files,
)
from robot.workers import Work, WorkerPool

INFO_FILE = "pictures.json"
SCHEMA_VERSION = 1
KINDS = ("photo", "touch")
_MAX_PRESSES = 3
"""Maximum number of presses of one object until the jaws meet it."""
Pictures = dict[str, npt.NDArray[np.uint8]]


def collect_pictures(
    kind: str,
    out: str | Path,
    *,
    objects: int,
    seed: int,
    rig: str = "sim",
    jobs: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Photograph or press the first `objects` objects of a simulated rig into `out`; continue an interrupted run.

    Args:
        kind: "photo" (one picture per object) or "touch" (one per finger).
        out: the folder to write or continue.
        objects: number of objects.
        seed: seed of the rig.
        rig: "sim" or the TOML file of a simulated rig.
        jobs: number of worker processes.
        progress: called with the number of finished objects and the number of all objects.

    Returns:
        The number of pictures in the folder.

    Raises:
        RobotConfigError: An argument or the rig file is invalid.
        RecordingError: The folder contains something else.
        StorageError: A file cannot be read or written.
    """
    if kind not in KINDS:
        raise RobotConfigError(f"pictures must be of kind {' or '.join(KINDS)}, got {kind!r}")
    make = functools.partial(_make_worker, kind, rig, seed)
    names = _load_sim_rig(rig, seed).object_ids(objects)
    folder = Path(out)
    info = {**_load_sim_rig(rig, seed).info, "schema_version": SCHEMA_VERSION, "kind": kind, "seed": seed}
    done = _open_folder(folder, info | {"software_version": software_version()})
    count = sum(done.values())
    left = [name for name in names if name not in done]
    with storage_errors(folder), WorkerPool(jobs, make(), make) as workers:
        for made, (name, (pictures, labels)) in enumerate(_ordered_results(workers, left), start=1):
            count += _write(folder, kind, name, pictures, labels)
            if progress is not None:
                progress(len(names) - len(left) + made, len(names))
    return count


def _load_sim_rig(rig: str, seed: int) -> SimRig:
    loaded = load_rig(rig, seed=seed)
    if not isinstance(loaded, SimRig):
        raise RobotConfigError(f"labelled pictures need a simulated rig, got {rig}")
    return loaded


def _make_worker(kind: str, rig: str, seed: int) -> Work[tuple[Pictures, Mapping[str, Any]]]:
    sim_rig = _load_sim_rig(rig, seed)

    def photograph(object_id: str, number: int) -> tuple[Pictures, Mapping[str, Any]]:
        sim_rig.prepare(object_id, number)
        return {"photo": sim_rig.sim_state.current_scene().image("photo")}, sim_rig.labels(object_id)

    def press(object_id: str, number: int) -> tuple[Pictures, Mapping[str, Any]]:
        tries = (sim_rig.press(object_id, number + each) for each in range(_MAX_PRESSES))
        return next((pictures for pictures in tries if pictures), {}), sim_rig.labels(object_id)

    return photograph if kind == "photo" else press


def _ordered_results(workers: WorkerPool[Any], names: list[str]) -> Iterator[tuple[str, Any]]:
    """Yield the result for each object in order, with a few results computed ahead."""
    pending: deque[tuple[str, Callable[[], Any]]] = deque()
    for name in names:
        pending.append((name, workers.submit(name, 0)))
        if len(pending) >= workers.window:
            first, result = pending.popleft()
            yield first, result()
    for first, result in pending:
        yield first, result()


def _open_folder(folder: Path, info: dict[str, Any]) -> dict[str, int]:
    """Create the folder, or check that its pictures were made with the same settings.

    Returns:
        The number of pictures of each object.
    """
    plain = json.loads(json.dumps(info))
    with storage_errors(folder):
        if (folder / INFO_FILE).exists():
            stored = read_json_object(folder / INFO_FILE, RecordingError)
            if differ := sorted(key for key in plain if key != "software_version" and stored.get(key) != plain[key]):
                raise RecordingError(
                    f"{folder} contains pictures made with other settings ({differ[0]} differs); give another --out"
                )
            return _completed_objects(folder / METADATA_FILE)
        ours = (IMAGES_FOLDER, METADATA_FILE, f".{METADATA_FILE}.", f".{INFO_FILE}.")
        if folder.exists() and any(not path.name.startswith(ours) for path in folder.iterdir()):
            raise RecordingError(f"{folder} must be a new folder or a folder of pictures; it contains something else")
        (folder / IMAGES_FOLDER).mkdir(parents=True, exist_ok=True)
        write_atomically(folder / METADATA_FILE, b"")
        write_atomically(folder / INFO_FILE, (json.dumps(plain, indent=1) + "\n").encode())
    return {}


def _completed_objects(path: Path) -> dict[str, int]:
    """Return the number of pictures of each complete object.

    If the last line is incomplete, it is cut off together with the last object, to which it may belong.
    """
    lines = read_content(path, RecordingError).splitlines(keepends=True)
    try:
        names = [json.loads(line)["object_id"] for line in lines if line.endswith(b"\n")]
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(
            f"{path} has a line that does not describe a picture ({error!r}); give another folder"
        ) from error
    if len(names) < len(lines):
        complete = [name for name in names if name != names[-1]]
        with open(path, "r+b") as file:
            file.truncate(sum(map(len, lines[: len(complete)])))
        names = complete
    return dict(Counter(names))


def _write(folder: Path, kind: str, object_id: str, pictures: Pictures, labels: Mapping[str, Any]) -> int:
    """Write an object's pictures, then all its lines at once; return the number of its pictures."""
    files, contents = {}, {}
    for name, pixels in pictures.items():
        data, suffix = file_content(name, pixels)
        files[name] = f"{IMAGES_FOLDER}/{object_id}-{name}{suffix}"
        contents[folder / files[name]] = data
    with sync_threads() as threads:
        write_files(contents, threads)
    rows = []
    for name in files:
        if name.endswith("_before"):
            continue
        row = {"file_name": files[name], "object_id": object_id, **labels}
        if kind == "touch":
            row |= {"finger": name.removeprefix("touch_"), "before_file_name": files[f"{name}_before"]}
        rows.append(json.dumps(row) + "\n")
    with open(folder / METADATA_FILE, "r+b", buffering=0) as file:
        append_line(file, file.seek(0, 2), "".join(rows).encode())
    return len(rows)
