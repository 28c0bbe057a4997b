"""Record emulated gels with LeRobot, import the data set, export it again and load it with LeRobot and `datasets`.

LeRobot is not among the requirements of the tests, so this is a program, not a test. In an environment with LeRobot,
this project and integrations/lerobot_camera_gelsight:

    python -m tests.integrations.lerobot_by_hand OUT

It runs LeRobot's own `lerobot-record` with a robot without motors and three emulated cameras: a scene, a GelSight Mini
and a DIGIT. LeRobot stores the pictures once as images and once as videos.
"""

import contextlib
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import torch

OUT = Path(sys.argv[1]).absolute()
os.environ.update(HF_LEROBOT_HOME=str(OUT / "home"), HF_HUB_OFFLINE="1", HF_DATASETS_CACHE=str(OUT / "cache"))
try:
    import torchvision  # noqa: F401
except RuntimeError:  # torchvision for CUDA with torch for the CPU lacks two operators that LeRobot does not use
    _OPERATORS = torch.library.Library("torchvision", "DEF")
    for _name in ("nms", "qnms"):
        _OPERATORS.define(f"{_name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

import lerobot_camera_gelsight  # noqa: E402, F401
from lerobot.cameras import CameraConfig, make_cameras_from_configs  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from lerobot.datasets.pipeline_features import aggregate_pipeline_dataset_features  # noqa: E402
from lerobot.robots import Robot, RobotConfig  # noqa: E402
from lerobot.scripts import lerobot_record  # noqa: E402
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig  # noqa: E402

from robot.recording.folder import read_recording  # noqa: E402
from tests.fake_video import FakeVideoDevice  # noqa: E402

FPS, EPISODES, EPISODE_S = 10, 4, 3.0
SIZES = {"scene": (160, 120), "gel_a": (320, 240), "gel_b": (320, 240)}
RETURNED: dict[str, list[np.ndarray]] = {}


class Gel(FakeVideoDevice):
    """A gel that is pressed again and again: a disc grows and shrinks, and every picture has other noise."""

    def picture(self, number):
        width, height = self.size
        y, x = np.mgrid[:height, :width]
        disc = np.hypot(x - width / 2, y - height / 2) < height / 4 * (1 - np.cos(number / 10))
        noise = np.random.default_rng(number).integers(-8, 9, (height, width, 3))
        shade = np.stack([60 + x // 4, 90 + y // 4, 120 - x // 8], -1)
        return np.clip(shade + 60 * disc[..., None] + noise, 0, 255).astype(np.uint8)


DEVICES = {name: Gel(fps=30.0, size=size) for name, size in SIZES.items()}


def expected(name, picture):
    """Return what a camera should deliver of an emulated picture, by plain slicing."""
    rgb = picture[..., ::-1]
    if name == "gel_a":  # GelSight Mini: 15 % less on each side
        return rgb[36:204, 48:272]
    return np.rot90(rgb) if name == "gel_b" else rgb


@RobotConfig.register_subclass("bench")
@dataclass
class BenchConfig(RobotConfig):
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class Bench(Robot):
    """Cameras only; one action that does nothing. It stores what the cameras return."""

    config_class, name = BenchConfig, "bench"
    is_calibrated = True

    def __init__(self, config):
        super().__init__(config)
        self.cameras = make_cameras_from_configs(config.cameras)

    @property
    def observation_features(self):
        return {name: (each.height, each.width, 3) for name, each in self.cameras.items()} | {"joint.pos": float}

    action_features = property(lambda self: {"joint.pos": float})
    is_connected = property(lambda self: all(each.is_connected for each in self.cameras.values()))

    def connect(self, calibrate=True):
        RETURNED.update({name: [] for name in self.cameras})
        for each in self.cameras.values():
            each.connect()

    def calibrate(self): ...
    def configure(self): ...

    def get_observation(self):
        pictures = {name: each.read_latest() for name, each in self.cameras.items()}
        for name, picture in pictures.items():
            RETURNED[name].append(picture.copy())
        return pictures | {"joint.pos": 0.0}

    def send_action(self, action):
        return action

    def disconnect(self):
        for each in self.cameras.values():
            each.disconnect()


@TeleoperatorConfig.register_subclass("bench_teleop")
@dataclass
class BenchTeleopConfig(TeleoperatorConfig): ...


class BenchTeleop(Teleoperator):
    config_class, name = BenchTeleopConfig, "bench_teleop"
    is_calibrated = is_connected = True
    action_features, feedback_features = {"joint.pos": float}, {}

    def connect(self, calibrate=True): ...
    def calibrate(self): ...
    def configure(self): ...
    def send_feedback(self, feedback): ...
    def disconnect(self): ...

    def get_action(self):
        return {"joint.pos": 0.0}


def with_images(pipeline, initial_features, use_videos):
    """Store cameras as images, as LeRobot 0.6 does; with `--dataset.video=false` version 0.4.4 leaves them out."""
    found = aggregate_pipeline_dataset_features(pipeline, initial_features)
    return {name: about | {"dtype": "image"} if about["dtype"] == "video" else about for name, about in found.items()}


def record(folder, *, video):
    """Run `lerobot-record`; return its data set, loaded again."""
    cameras = ", ".join(
        f"{name}: {{type: gelsight, sensor: {sensor}, device: {OUT / 'dev' / name}{more}}}"
        for name, sensor, more in (
            ("scene", "uvc", ", fps: 30, width: 160, height: 120"),
            ("gel_a", "gelsight_mini", ""),
            ("gel_b", "digit", ", settings: {led: [8, 8, 8]}"),
        )
    )
    arguments = {
        "robot.type": "bench",
        "robot.id": "bench",
        "robot.cameras": "{" + cameras + "}",
        "teleop.type": "bench_teleop",
        "dataset.repo_id": "bench/gels",
        "dataset.root": folder,
        "dataset.single_task": "press a disc",
        "dataset.fps": FPS,
        "dataset.num_episodes": EPISODES,
        "dataset.episode_time_s": EPISODE_S,
        "dataset.reset_time_s": 0,
        "dataset.video": str(video).lower(),
        "dataset.push_to_hub": "false",
        "play_sounds": "false",
    }
    sys.argv = ["lerobot-record", *(f"--{name}={value}" for name, value in arguments.items())]
    with contextlib.ExitStack() as stack:
        if not video:
            stack.enter_context(mock.patch.object(lerobot_record, "aggregate_pipeline_dataset_features", with_images))
        lerobot_record.main()
    return LeRobotDataset("bench/gels", root=folder)


def pixels_of(dataset):
    """Return the pictures through LeRobot's loader: camera -> list of (H, W, 3) uint8."""
    pictures = {key.removeprefix("observation.images."): [] for key in dataset.meta.camera_keys}
    for index in range(len(dataset)):
        step = dataset[index]
        for name, found in pictures.items():
            picture = step[f"observation.images.{name}"]
            found.append((255 * picture.permute(1, 2, 0)).round().to(torch.uint8).numpy())
    return pictures


def rms(one, other):
    """Return the root mean square difference in grey levels."""
    return float(np.sqrt(np.mean((np.asarray(one, np.float64) - np.asarray(other, np.float64)) ** 2)))


def retrieve(*arguments):
    """Run a command of this project."""
    subprocess.run([sys.executable, "-m", "retrieval", *map(str, arguments)], check=True)


def check_recorded(pixels, what):
    """Compare the data set with what the cameras returned, and that with the emulated pictures."""
    for name, device in DEVICES.items():
        loaded, returned = pixels[name], RETURNED[name]
        known = {expected(name, device.picture(number)).tobytes() for number in range(1, device.pictures + 1)}
        exact = sum(picture.tobytes() in known for picture in returned)
        worst = max(rms(one, other) for one, other in zip(loaded, returned, strict=True))
        print(
            f"{what} {name}: {len(loaded)} frames {loaded[0].shape}; camera exact in {exact}; largest RMS {worst:.3g}"
        )


def check_imported(pixels, folder, what):
    """Compare the touches of an imported recording with the frames that LeRobot's loader returns."""
    recording = read_recording(folder)
    for finger, name in (("a", "gel_a"), ("b", "gel_b")):
        files = [path for grasp in recording.grasps for key, path in grasp.images().items() if f"touch_{finger}" in key]
        pictures = [cv2.imread(str(folder / path))[..., ::-1] for path in files]
        nearest = [min(rms(picture, frame) for frame in pixels[name]) for picture in pictures]
        print(f"{what} {name}: {len(recording.grasps)} grasps, {len(pictures)} pictures; RMS {max(nearest):.3g}")


def check_exported(recording_folder):
    """Load our export with LeRobot."""
    recording = read_recording(recording_folder)
    retrieve("export-recording", recording_folder, "--out", OUT / "export")
    dataset = LeRobotDataset("bench/export", root=OUT / "export")
    frames = pixels_of(dataset)["touch_a"]
    moments = [int(dataset[index]["moment"]) for index in range(len(dataset))]
    touched = [frame for frame, moment in zip(frames, moments, strict=True) if moment == 1]
    stored = [cv2.imread(str(recording_folder / grasp.touches["a"]))[..., ::-1] for grasp in recording.grasps]
    worst = max(rms(one, other) for one, other in zip(touched, stored, strict=True))
    print(f"export lerobot: {dataset.num_episodes} episodes, {len(dataset)} frames; largest RMS of touch_a {worst:.3g}")
    loader = torch.utils.data.DataLoader(dataset, batch_size=4)  # as in LeRobot's training
    print(f"export lerobot: task {dataset[0]['task']!r}; one batch {next(iter(loader))['index'].shape}")


def main():
    (OUT / "dev").mkdir(parents=True)
    for name in DEVICES:
        (OUT / "dev" / name).touch()
    with contextlib.ExitStack() as stack:
        by_path = {str((OUT / "dev" / name).resolve()): device for name, device in DEVICES.items()}
        stack.enter_context(mock.patch.object(cv2, "VideoCapture", lambda path, _: by_path[path].open(path)))
        for what in ("images", "videos"):
            pixels = pixels_of(record(OUT / what, video=what == "videos"))
            check_recorded(pixels, f"record {what}")
            folder = OUT / f"recording-{what}"
            retrieve("import", "lerobot", OUT / what, "--out", folder)
            check_imported(pixels, folder, f"import {what}")
    check_exported(OUT / "recording-images")


if __name__ == "__main__":
    main()
