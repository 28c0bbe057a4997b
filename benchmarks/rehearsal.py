"""A rehearsal without hardware: `python -m benchmarks.rehearsal --out rehearsal/` collects, trains, indexes, queries.

A rig from a file (a manual arm without a person, the WSG-50's driver on an emulated gripper, gels and a depth camera
that replay a recording) collects its own recording. The replayed frames follow the emulated gripper: the gel before,
during the hold, and after the lift. Then the commands for any recording run on the result.
"""

import argparse
import contextlib
import json
import os
import shutil
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np

from retrieval.commands.main import main as retrieve
from robot.readings import Frame, Intrinsics
from robot.recording.folder import read_info, read_recording
from robot.rig import load_rig
from robot.sight import hand_eye
from tests.emulated_rig import HOLDING
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.server import serve_tcp
from tests.replay_rig import FILE

OBJECTS, GRASPS, SEED = 8, 3, 31
MOMENTS = ("before", "during", "after")


def rehearse(folder, objects=OBJECTS, grasps=GRASPS, iterations=2):
    """Run all steps in `folder`; return the replayed recording and the new one."""
    os.environ["XDG_STATE_HOME"] = str(folder / "state")  # do not make the trained model the default
    source, made = folder / "source", folder / "recording"
    _run("collect", "--rig", "sim", "--objects", objects, "--grasps", grasps, "--seed", SEED, "--out", source)
    with replayed(folder, source, grasps) as name:
        _run("collect", "--rig", name, "--objects", objects, "--grasps", grasps, "--out", made)
    _run("check", made)
    _run("train", made, "--out", folder / "model.safetensors", "--iterations", iterations)
    catalogue = folder / "catalog"
    for grasp in read_recording(made).grasps:
        (catalogue / grasp.object_id).mkdir(parents=True, exist_ok=True)
        shutil.copy(made / grasp.photo, catalogue / grasp.object_id)
    _run("build-index", catalogue, "--model", folder / "model.safetensors", "--out", folder / "index")
    first = read_recording(made).grasps[0]
    touches = [made / first.touches[finger] for finger in sorted(first.touches)]
    _run("query", "--gelsight", *touches, "--index", folder / "index", "--html", folder / "query.html")
    return source, made


@contextlib.contextmanager
def replayed(folder, source, grasps):
    """Yield the name of a rig that replays the recording `source`."""
    emulator = EmulatedWSG50(speed_up=50.0, referenced=True)
    with (
        serve_tcp(emulator) as url,
        patch("robot.rig.input", lambda: "", create=True),
        patch("robot.rig.load_rig", partial(_load, emulator, url, folder, source)),
    ):
        yield "rehearsal"


def _load(emulator, url, folder, source, spec, *, seed):
    """Load the rig of a file, and synchronise its replaying devices."""
    if spec != "rehearsal":
        return load_rig(spec, seed=seed)
    lens = _prepare(folder, source)
    path = folder / "rig.toml"
    path.write_text(FILE.format(port=url, folder=folder, lens=lens).replace("/recording", "/source"))
    rig = load_rig(str(path), seed=seed)
    cue = Cue(source, emulator, rig)
    rig.prepare, rig.object_ids = cue.prepare, cue.object_ids
    for sensor in rig.sensors.values():
        sensor._read = partial(cue.gel, sensor)
        sensor._read_near = lambda time_s, sensor=sensor: cue.gel(sensor)
    return rig


class Cue:
    """Selects the recorded grasp and its moment."""

    def __init__(self, source, emulator, rig):
        self.grasps, self.emulator, self.rig = read_recording(source).grasps, emulator, rig
        self.number, self.lifted_from = 0, None

    def object_ids(self, count):
        return list(dict.fromkeys(grasp.object_id for grasp in self.grasps))[:count]

    def prepare(self, object_id, number):
        own = [place for place, grasp in enumerate(self.grasps) if grasp.object_id == object_id]
        self.number = own[number % len(own)]
        self.rig.camera.seek(self.number)
        grasp = self.grasps[self.number]
        self.emulator.object_mm = grasp.opening_mm if grasp.outcome == "held" else None
        self.lifted_from = None

    def gel(self, sensor):
        return Frame(sensor.pictures[3 * self.number + MOMENTS.index(self._moment())], sensor.clock())

    def _moment(self):
        if self.emulator.grasping != HOLDING:
            return "before" if self.lifted_from is None else "after"
        height = self.rig.arm.pose().z_mm
        if self.lifted_from is None:
            self.lifted_from = height
        return "after" if height > self.lifted_from + 1 else "during"


def _prepare(folder, source):
    """Write the gels' pictures and a calibration file; return the intrinsics of the recorded camera."""
    for finger in "ab":
        (folder / finger).mkdir(exist_ok=True)
        for number, grasp in enumerate(read_recording(source).grasps):
            moments = (grasp.touches_before, grasp.touches, grasp.touches_after)
            for moment, touches in enumerate(moments):
                shutil.copy(source / touches[finger], folder / finger / f"{number:05}-{moment}.jpg")
    info = read_info(source)
    camera = load_rig(info["rig"], seed=info["seed"], **info["rig_settings"]).camera
    points = np.random.default_rng(1).uniform((-200, -200, 600), (200, 200, 900), (8, 3))
    rig_points = points @ camera.extrinsics[:3, :3].T + camera.extrinsics[:3, 3]
    hand_eye.fit_hand_eye(points, rig_points).save(folder / "hand_eye.json")
    settings = info["devices"][camera.name]
    centre = (settings["px"] - 1) / 2
    return Intrinsics(settings["focal_px"], settings["focal_px"], centre, centre)


def _run(*words):
    code = retrieve([str(word) for word in words])
    assert code == 0, words


def main():
    """Run the whole rehearsal in a folder; the commands print to stderr."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rehearsal", description=main.__doc__)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    source, made = rehearse(arguments.out)
    print(json.dumps({name: len(read_recording(each).grasps) for name, each in (("source", source), ("made", made))}))


if __name__ == "__main__":
    main()
