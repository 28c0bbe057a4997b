"""Labelled pictures of simulated objects, which need no grasp: photos, or presses of both fingers.

    metadata.jsonl    a line for each object: object_id, its labels (`robot.sim.objects.draw.SimObject.labels`), and
                      the names of its pictures under "pictures": photo, or touch_a, touch_a_before, touch_b, ...; for
                      several photos the names of their conditions with a number, and for varied ones also a mask of
                      the object's pixels (`MASK_PX` a side, white), varied-0_mask, ..., and under "field_mm" the
                      millimetres that each of these photos shows along a side
    images/           the pictures

A photographed object takes a tenth of the time of a grasp, and a press a third. An object's line is written when its
pictures are on disk; an interrupted collection continues.
"""

import contextlib
import functools
import itertools
import json
import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from models.photography import CONDITIONS, Photography, Shot, develop, draw, shoot
from retrieval.console.progress import Bar
from robot.rig import load_rig
from robot.sim.camera import PinholeCamera
from robot.sim.rig import SimRig
from robot.sim.scene import Scene
from robot.storage import SYNC_THREADS, LineFile, file_content, write_files
from robot.workers import Work, WorkerPool

FAMILIES = ("relief", "shape")
SIZES = ("pitch_mm", "amplitude_mm", "aspect", "sharpness")
MIN_AMPLITUDE_MM = 0.05
"""Smaller amplitudes are raised to this one."""
MAX_PRESSES = 3
"""Maximum number of presses of one object until the jaws meet it."""
PHOTOS = {"varied": 3, "conditions": 3}
"""Photos of an object, in varied conditions or in each condition."""
MASK_PX = 128
_PARTNERS = ("_before", "_mask")
"""Ends of the names of pictures that belong to another one."""
FIRST_PHOTO = 1000
"""Number of the placement in the first of several photos; smaller numbers are those of attempts."""
IMAGES, METADATA = "images", "metadata.jsonl"
Pictures = dict[str, NDArray[np.uint8]]


@dataclass(frozen=True)
class ObjectLabels:
    """The properties of a simulated object that both its touches and its photos show.

    Attributes:
        families: Its relief and shape families, in the order of `FAMILIES`.
        sizes: Sizes of its relief, in the order of `SIZES`; the amplitude of a smooth object is 0.
    """

    families: tuple[str, ...]
    sizes: tuple[float, ...]

    @property
    def is_smooth(self) -> bool:
        """Whether the object has no relief; its pitch, aspect and sharpness then have no meaning."""
        return self.sizes[SIZES.index("amplitude_mm")] == 0

    @property
    def size_targets(self) -> tuple[float, ...]:
        """`sizes` for regression: logarithms of all but the sharpness."""
        pitch, amplitude, aspect, sharpness = self.sizes
        return math.log(pitch), math.log(max(amplitude, MIN_AMPLITUDE_MM)), math.log(aspect), sharpness

    @classmethod
    def from_dict(cls, row: Mapping[str, Any]) -> "ObjectLabels":
        """Read the labels that the simulated rig writes."""
        return cls(tuple(row[name] for name in FAMILIES), tuple(float(row[name]) for name in SIZES))


@dataclass(frozen=True)
class LabelledPicture:
    """A photo, or one finger's gel image, and the labels of its object.

    Attributes:
        name: Name of the picture.
        file: Its file.
        before: File of the finger's no-contact frame.
        mask: File of the mask of the object's pixels in a varied photo.
        object_id: The object.
        labels: Its labels.
        field_mm: What a varied photo shows along a side, in millimetres.
        roll_rad: The roll of the camera of a varied photo.
    """

    name: str
    file: Path
    before: Path | None
    mask: Path | None
    object_id: str
    labels: ObjectLabels
    field_mm: float | None
    roll_rad: float | None


def collect_pictures(
    kind: str, folder: Path, *, objects: int, seed: int, rig: str = "sim", jobs: int = 1
) -> list[LabelledPicture]:
    """Photograph or press the first objects of a simulated rig, or continue; return all pictures.

    Args:
        kind: "photo" (one picture of each object), "varied" (`PHOTOS` taken as `photography.draw` decides, with
            masks), "conditions" (`PHOTOS` in each of `CONDITIONS`) or "touch" (one of each finger).
        folder: The folder to write or continue. It must belong to the same kind, seed and rig.
        objects: Number of objects.
        seed: Seed of the rig.
        rig: "sim" or the TOML file of a simulated rig.
        jobs: Number of worker processes.
    """
    make = functools.partial(_worker, kind, rig, seed)
    names = _sim_rig(rig, seed).object_ids(objects)
    (folder / IMAGES).mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        metadata = stack.enter_context(LineFile(folder / METADATA))
        lines = metadata.read()
        metadata.keep(len(lines))
        done = {json.loads(line)["object_id"] for line in lines.splitlines()}
        missing = iter([name for name in names if name not in done])
        bar = stack.enter_context(Bar(f"collect {kind}", len(names), "objects", done=len(done)))
        workers = stack.enter_context(WorkerPool(jobs, make(), make))
        threads = stack.enter_context(ThreadPoolExecutor(SYNC_THREADS))
        waiting = [(name, workers.submit(name, 0)) for name in itertools.islice(missing, workers.window)]
        while waiting:
            name, result = waiting.pop(0)
            waiting += [(new, workers.submit(new, 0)) for new in itertools.islice(missing, 1)]
            pictures, labels = result()
            files, contents = {}, {}
            for which, pixels in pictures.items():
                data, suffix = file_content(which, pixels)
                files[which] = f"{IMAGES}/{name}-{which}{suffix}"
                contents[folder / files[which]] = data
            write_files(contents, threads)
            metadata.append(json.dumps({"object_id": name, **labels, "pictures": files}).encode())
            bar.advance()
    return load_pictures(folder)


def load_pictures(folder: Path) -> list[LabelledPicture]:
    """Return the pictures that `collect_pictures` wrote; each finger of a press is one picture."""
    pictures = []
    for line in (folder / METADATA).read_text().splitlines():
        row = json.loads(line)
        files = {name: folder / file for name, file in row["pictures"].items()}
        for name, file in files.items():
            if not name.endswith(_PARTNERS):
                partners = (files.get(name + end) for end in _PARTNERS)
                camera = (row.get(what, {}).get(name) for what in ("field_mm", "roll_rad"))
                pictures.append(
                    LabelledPicture(name, file, *partners, row["object_id"], ObjectLabels.from_dict(row), *camera)
                )
    return pictures


def _sim_rig(rig: str, seed: int) -> SimRig:
    loaded = load_rig(rig, seed=seed)
    assert isinstance(loaded, SimRig)
    return loaded


def _worker(kind: str, rig: str, seed: int) -> Work[tuple[Pictures, Mapping[str, Any]]]:
    sim_rig = _sim_rig(rig, seed)

    def photograph(object_id: str, number: int) -> tuple[Pictures, Mapping[str, Any]]:
        sim_rig.prepare(object_id, number)
        return {"photo": sim_rig.sim_state.current_scene().image("photo")}, sim_rig.labels(object_id)

    def press(object_id: str, number: int) -> tuple[Pictures, Mapping[str, Any]]:
        tries = (sim_rig.press(object_id, number + each) for each in range(MAX_PRESSES))
        return next((pictures for pictures in tries if pictures), {}), sim_rig.labels(object_id)

    def several(object_id: str, number: int) -> tuple[Pictures, Mapping[str, Any]]:
        pictures, fields, rolls = {}, {}, {}
        for number in range(PHOTOS[kind]):
            sim_rig.prepare(object_id, FIRST_PHOTO + number)
            scene = sim_rig.sim_state.current_scene()
            if kind == "conditions":
                pictures |= _photo_in_each_condition(scene, number)
            else:
                how = draw(np.random.default_rng([95, scene.seed]))
                pictures |= _varied_photo(scene, how, number)
                fields[f"varied-{number}"], rolls[f"varied-{number}"] = how.camera.field_mm, how.camera.roll_rad
        return pictures, {**sim_rig.labels(object_id), "field_mm": fields, "roll_rad": rolls}

    return {"photo": photograph, "touch": press, "varied": several, "conditions": several}[kind]


def _varied_photo(scene: Scene, how: Photography, number: int) -> Pictures:
    shot = shoot(scene, how.camera)
    mask = shot.view.is_object.reshape(how.camera.px, how.camera.px).astype(np.float32)
    levels = np.rint(255 * cv2.resize(mask, (MASK_PX, MASK_PX), interpolation=cv2.INTER_AREA)).astype(np.uint8)
    name, photo = f"varied-{number}", develop(shot, how, scene.seed)
    return {name: photo, f"{name}_mask": np.repeat(levels[..., None], 3, axis=2)}


def _photo_in_each_condition(scene: Scene, number: int) -> Pictures:
    shots: dict[PinholeCamera, Shot] = {}
    pictures = {}
    for name, how in CONDITIONS.items():
        if how.camera not in shots:
            shots[how.camera] = shoot(scene, how.camera)
        pictures[f"{name}-{number}"] = develop(shots[how.camera], how, scene.seed)
    return pictures
