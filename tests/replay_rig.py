"""A rig from a file: a manual arm, an emulated gripper, recorded gels and recorded depth. It needs no person.

Its pictures come from a recording of the fake rig in tests/fake_rig.py. `FolderSensor` and `RecordedCamera` show
recorded pictures as a gel and as a camera.
"""

import contextlib
import math
import shutil
import tempfile
import time
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np

from robot.collection import CollectSettings, collect
from robot.devices import Camera, TactileSensor, VirtualDevice
from robot.readings import RGBD, Frame
from robot.recording.folder import read_recording
from robot.sight import hand_eye
from tests import views
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.server import serve
from tests.fake_rig import LENS, FakeRig

FILE = """
rig = "real"
source = "replayed"
sensor = "fake gel"
attempt = {{settle_s = 0.1, hold_s = 0.1}}
[limits]
workspace_lower_mm = [-150, -150, 8]
workspace_upper_mm = [150, 150, 500]
arm_speed_mm_s = 1000
jaw_speed_mm_s = 400
[arm]
driver = "manual"
[gripper]
driver = "wsg50"
host = "127.0.0.1"
port = {port}
[sensors.a]
driver = "tests.replay_rig:FolderSensor"
path = "{folder}/a"
[sensors.b]
driver = "tests.replay_rig:FolderSensor"
path = "{folder}/b"
[camera]
driver = "tests.replay_rig:RecordedCamera"
path = "{folder}/recording"
hand_eye = "{folder}/hand_eye.json"
"""


class FolderSensor(VirtualDevice, TactileSensor):
    """Shows the pictures of a folder in the order of their names, 30 in a second, again and again."""

    def __init__(self, *, finger: str, path: str, clock=time.monotonic):
        super().__init__(f"gel {finger}", finger, clock=clock)
        self.path = Path(path)

    def _connect(self):
        self.pictures = [cv2.imread(str(each))[..., ::-1].copy() for each in sorted(self.path.iterdir())]

    def _read(self):
        number = math.floor(30 * self.clock())
        return Frame(self.pictures[number % len(self.pictures)], number / 30)


class RecordedCamera(VirtualDevice, Camera):
    """Shows the next photo of a recording, with its depth, at each read."""

    def __init__(self, *, path: str, extrinsics, clock=time.monotonic):
        super().__init__("recorded camera", extrinsics, clock=clock)
        self.path = Path(path)

    def _connect(self):
        self.grasps, self.next = read_recording(self.path).grasps, 0

    def _read(self, depth):
        grasp = self.grasps[self.next % len(self.grasps)]
        self.next += 1
        colour = cv2.imread(str(self.path / grasp.photo))[..., ::-1].copy()
        depth_mm = cv2.imread(str(self.path / grasp.depth), cv2.IMREAD_UNCHANGED)
        depth_m = np.where(depth_mm > 0, depth_mm * np.float32(1e-3), np.float32(np.nan))
        return RGBD(colour, depth_m if depth else None, LENS, self.clock())


@contextlib.contextmanager
def replay_file(emulator=None):
    """The file of the rig; its devices exist while the context is open, and prompts to a person return at once."""
    emulator = emulator or EmulatedWSG50(speed_up=50.0, referenced=True)
    with (
        tempfile.TemporaryDirectory() as name,
        serve(emulator) as port,
        patch("robot.rig.input", lambda: "", create=True),
    ):
        folder = Path(name)
        record(folder)
        (folder / "rig.toml").write_text(FILE.format(port=port, folder=folder))
        yield folder / "rig.toml"


def record(folder):
    """Write a recording, a folder of gel pictures for each finger, and a calibration of the camera."""
    settings = CollectSettings(grasps=2)
    collect(lambda: FakeRig(5), folder / "recording", objects=["round-0", "round-1"], seed=5, settings=settings)
    for finger in "ab":
        (folder / finger).mkdir()
        for grasp in read_recording(folder / "recording").grasps:
            for moment in (grasp.touches_before, grasp.touches, grasp.touches_after):
                shutil.copy(folder / "recording" / moment[finger], folder / finger)
    camera = np.random.default_rng(1).uniform((-200, -200, 700), (200, 200, 1100), (8, 3))
    matrix = views.camera_pose()
    hand_eye.fit_hand_eye(camera, camera @ matrix[:3, :3].T + matrix[:3, 3]).save(folder / "hand_eye.json")
