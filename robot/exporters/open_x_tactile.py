"""Open-X-Tactile in the layout of FTP-1: a zarr store, version 2, with arrays along time.

The layout follows notes on the published stores, not a store: names, shapes and types of `data` and
`meta/episode_ends` are from these notes; the strings in the arrays for sensor and type are not verified.

    grasps.zarr/meta/episode_ends                (E,) int64: end of each episode; an episode is a grasp
    grasps.zarr/data/camera_main_rgb             (T, H, W, 3) uint8: the photo, the same in all steps of an episode
    grasps.zarr/data/right_tactile_data_0        (T, fingers, H, W, 3) uint8
    grasps.zarr/data/right_tactile_{sensor,type,area}_0    name of the sensor, "image", and (fingers,) int64: 0, 1, ...

Our own additions: meta/object_id, meta/grasp_id and further recorded fields of a grasp, (E,) each, and meta/moment,
(steps of an episode,): "before", "during", "after". Splits are ranges of episodes in the attributes of the store.
All pictures of a camera have the size of the first one.
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from robot.exporters.exporting import (
    EpisodeSteps,
    Parts,
    RecordingExport,
    atomic_folder,
    grasps_by_part,
    plain_fields,
    recording_facts,
)
from robot.importers.importing import Progress, import_extra
from robot.recording.folder import RecordedGrasp, Recording

STORE = "grasps.zarr"
_WHAT = "the format of Open-X-Tactile"


def export_open_x_tactile(
    recording: Recording, out: Path, *, parts: Parts | None = None, progress: Progress | None = None
) -> RecordingExport:
    """Write a zarr store, version 2.

    Args:
        recording: The recording.
        out: New or empty folder.
        parts: Split of the objects; None for all in the training part.
        progress: Called with (done, total) after each grasp.

    Raises:
        RecordingError: A picture is damaged, grasps differ in their fingers, or the split is invalid.
        ImporterError: zarr is missing.
        StorageError: The folder cannot be written.
    """
    zarr = import_extra("zarr", _WHAT)
    found, notes = grasps_by_part(recording, parts)
    grasps = [grasp for part in found.values() for grasp in part]
    steps = EpisodeSteps(recording, grasps)
    length = len(steps.moments)
    if len({steps.sizes[f"touch_{finger}"] for finger in steps.fingers}) > 1:
        for finger in steps.fingers[1:]:
            steps.sizes[f"touch_{finger}"] = steps.sizes[f"touch_{steps.fingers[0]}"]
    with atomic_folder(out) as folder:
        root = zarr.open_group(str(folder / STORE), mode="w", zarr_format=2)
        ends = np.cumsum([0, *map(len, found.values())]).tolist()
        root.attrs["splits"] = {part: [ends[number], ends[number + 1]] for number, part in enumerate(found)}
        root.attrs["recording"] = recording_facts(recording)
        data, meta = root.create_group("data"), root.create_group("meta")
        photo, touch = (steps.sizes[name] for name in ("photo", f"touch_{steps.fingers[0]}"))
        photos = _frames(data, "camera_main_rgb", len(grasps) * length, (*photo, 3))
        touches = _frames(data, "right_tactile_data_0", len(grasps) * length, (len(steps.fingers), *touch, 3))
        _store(data, "right_tactile_sensor_0", np.array([str(recording.info["sensor"])]))
        _store(data, "right_tactile_type_0", np.array(["image"]))
        _store(data, "right_tactile_area_0", np.arange(len(steps.fingers), dtype=np.int64))
        for episode, grasp in enumerate(grasps):
            pictures = steps.pictures_of(grasp)
            span = slice(episode * length, (episode + 1) * length)
            photos[span] = np.stack(pictures["photo"])
            touches[span] = np.stack([np.stack(pictures[f"touch_{finger}"]) for finger in steps.fingers], axis=1)
            if progress is not None:
                progress(episode + 1, len(grasps))
        for name, values in _field_arrays(grasps).items():
            _store(meta, name, values)
        _store(meta, "moment", np.array(steps.moments))
        _store(meta, "episode_ends", length * np.arange(1, len(grasps) + 1, dtype=np.int64))
    return RecordingExport(out, len(grasps), (*notes, *steps.remarks()))


def _frames(group: Any, name: str, count: int, shape: tuple[int, ...]) -> Any:
    """Create an array of pictures along time, one chunk per step."""
    return group.create_array(name, shape=(count, *shape), chunks=(1, *shape), dtype="uint8")


def _store(group: Any, name: str, values: np.ndarray[Any, Any]) -> None:
    with warnings.catch_warnings():  # zarr warns about strings in stores of version 3
        warnings.simplefilter("ignore")
        array = group.create_array(name, shape=values.shape, chunks=values.shape, dtype=values.dtype)
    array[...] = values


def _field_arrays(grasps: list[RecordedGrasp]) -> dict[str, np.ndarray[Any, Any]]:
    """Return the recorded fields of all grasps as arrays by key.

    Strings and numbers are (E,), with "" or NaN for missing ones; grasped is 1, 0 or -1 (unknown); poses are (E, k).
    """
    rows = [plain_fields(grasp) for grasp in grasps]
    found: dict[str, np.ndarray[Any, Any]] = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        values: list[Any] = [row.get(key) for row in rows]
        known = next(value for value in values if value is not None)
        if isinstance(known, str):
            found[key] = np.array([value or "" for value in values])
        elif isinstance(known, bool):
            found[key] = np.array([-1 if value is None else int(value) for value in values], dtype=np.int8)
        elif isinstance(known, float):
            found[key] = np.array([np.nan if value is None else value for value in values])
        else:
            width = max(len(value) for value in values if value is not None)
            found[key] = np.array([[*(value or ()), *[np.nan] * width][:width] for value in values])
    return found
