"""A rig of the real drivers over emulated devices, in one world: what the hand does, the gels and the camera see.

    python -m tests.emulated_rig --grasps 500 --out faulty/       # with faults in 1 of 50 operations, counted

The gripper's driver speaks to an emulated WSG-50 over TCP or a pseudo-terminal, the gels' driver to cameras of
arithmetic through OpenCV's interface, and Sawyer's to an emulated one over a websocket, unless an arm of this file
does, which is at its place at once. The camera is of this file too. Faults can be had at every device, counted by kind.
"""

import argparse
import contextlib
import logging
import math
import time
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np

from robot.collection import CollectSettings, collect
from robot.devices import Arm, Camera
from robot.drivers.gels.opencv import OpencvTactile
from robot.drivers.sawyer.driver import Sawyer
from robot.drivers.video import opencv_stream
from robot.drivers.wsg50.driver import WSG50
from robot.errors import DeviceError
from robot.grasping.settings import AttemptSettings, GraspSettings
from robot.readings import RGBD, Intrinsics, Pose, Region
from robot.recording.folder import read_recording
from robot.rig import Rig
from tests import views
from tests.emulators.sawyer import server as rosbridge_emulator
from tests.emulators.wsg50.faults import LineFaults
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.server import serve_pty, serve_tcp
from tests.fake_video import FakeVideoDevice

WORKSPACE = Region((-150.0, -150.0, 8.0), (150.0, 150.0, 500.0))
LENS, PX = Intrinsics(120.0, 120.0, 63.5, 53.5), (108, 128)
HOLDING = 4
SPEED_UP = 50.0
FRAMES = 4
"""Frames on the line for an operation of the gripper: command, pending, state, result. Each may meet a fault."""
LOW_WORKSPACE = Region((-150.0, -150.0, 0.0), (150.0, 150.0, 300.0))
"""Where the emulated Sawyer reaches."""
QUICK = AttemptSettings(
    GraspSettings(lift_mm=100.0), settle_s=0.1, hold_s=0.1, travel_mm_s=1000.0, closing_mm_s=400.0, retries=4
)
SERVERS = {"tcp": serve_tcp, "pty": serve_pty}


class EmulatedRigState:
    """What all devices share. rate: how often an operation of arm, camera or a gel's stream meets a fault."""

    def __init__(self, seed, rate=0.0):
        self.seed, self.rate = seed, rate
        self.rng, self.counts = np.random.default_rng([7, seed]), Counter()
        self.emulator = EmulatedWSG50(speed_up=SPEED_UP, referenced=True)
        self.line = LineFaults(rate / FRAMES, seed=seed)
        self.arm_faults, self.left_moving = None, 0
        self.pose, self.solid, self.slips, self.noise = Pose(0, 0, 300, 0), None, False, 0

    def fault(self, device, *kinds):
        """The kind of fault that this operation of a device meets, or None."""
        if not kinds or self.rng.uniform() >= self.rate:
            return None
        kind = str(self.rng.choice(kinds))
        self.counts[f"{device}: {kind}"] += 1
        return kind

    @property
    def all_counts(self):
        """Faults so far, by device and kind."""
        lines = {"gripper's line": self.line.counts, "arm's line": self.arm_faults.counts if self.arm_faults else {}}
        of_lines = {f"{line}: {kind}": count for line, counts in lines.items() for kind, count in counts.items()}
        return dict(self.counts) | of_lines

    @property
    def holding(self):
        return self.emulator.grasping == HOLDING and self.emulator.object_mm is not None

    def hand_at(self, pose):
        """The hand has been moved, and with it what it holds; else the jaws now stand about what is there."""
        lifted, self.pose = pose.z_mm > self.pose.z_mm + 1, pose
        if not self.holding:
            self.emulator.object_mm = self._chord(pose)
        elif self.slips and lifted:
            self.emulator.object_mm = None

    def _chord(self, pose):
        """Width of the cylinder between the fingers, None where they meet nothing."""
        solid = self.solid
        if solid is None or pose.z_mm > solid.height:
            return None
        across = -math.sin(pose.yaw_rad) * (solid.x - pose.x_mm) + math.cos(pose.yaw_rad) * (solid.y - pose.y_mm)
        return 2 * math.sqrt(solid.radius**2 - across**2) if abs(across) < solid.radius else None


class EmulatedArm(Arm):
    """At its place at once, unless it fails."""

    def __init__(self, world):
        super().__init__("emulated arm", WORKSPACE)
        self.world = world

    def _connect(self): ...

    def _close(self): ...

    def _stop(self): ...

    def _move_to(self, pose, speed_mm_s):
        kind = self.world.fault("arm", "did not arrive", "link lost")
        if kind == "link lost":
            raise OSError(104, "Connection reset by peer")
        if kind:
            raise DeviceError("the emulated arm must arrive within 5 s, it is 40 mm off")
        self.world.hand_at(pose)
        return pose

    def _pose(self):
        return self.world.pose


class TrackedSawyer(Sawyer):
    """Sawyer's driver; the world learns where it has gone."""

    def __init__(self, world, port):
        mount = {"base_xyz_mm": [500.0, 0.0, -100.0], "base_yaw_deg": 180.0, "tool_mm": 150.0}
        quick = {"joint_speed_rad_s": 1.5, "max_speed_mm_s": 1000.0, "max_state_age_s": 1.0, "timeout_s": 0.5}
        super().__init__(workspace=LOW_WORKSPACE, host="127.0.0.1", port=port, **mount, **quick)
        self.world = world

    def _move_to(self, pose, speed_mm_s):
        reached = super()._move_to(pose, speed_mm_s)
        self.world.hand_at(reached)
        return reached


class WatchedWSG50(WSG50):
    """The gripper's driver; the world counts how often one of its calls ends, well or badly, with jaws that move."""

    def __init__(self, world, **settings):
        super().__init__(**settings)
        self.world = world

    def open(self, opening_mm):
        with self._watched():
            return super().open(opening_mm)

    def grasp(self, force_n, speed_mm_s=80.0):
        with self._watched():
            return super().grasp(force_n, speed_mm_s)

    def close(self):
        with self._watched():
            super().close()

    @contextlib.contextmanager
    def _watched(self):
        try:
            yield
        finally:
            self.world.left_moving += self.world.emulator.moves


@contextlib.contextmanager
def _at_once(world):
    yield EmulatedArm(world)


@contextlib.contextmanager
def _sawyer(world):
    world.arm_faults = rosbridge_emulator.MessageFaults(world.rate, seed=world.seed)
    with rosbridge_emulator.serve(rosbridge_emulator.EmulatedSawyer(faults=world.arm_faults)) as url:
        yield TrackedSawyer(world, int(url.rpartition(":")[2]))


ARMS = {"at once": _at_once, "sawyer": _sawyer}


class EmulatedCamera(Camera):
    """Sees the cylinder that stands on the table."""

    def __init__(self, world):
        super().__init__("emulated camera", views.camera_pose())
        self.world = world

    def _connect(self): ...

    def _close(self): ...

    def _read(self, depth):
        kind = self.world.fault("camera", "unplugged", "stale", "blind")
        if kind == "unplugged":
            raise OSError(19, "No such device")
        world = self.world
        image = views.view(*([world.solid] if world.solid else []), seed=world.noise, lens=LENS, px=PX)
        depth_m = np.full(PX, np.nan, np.float32) if kind == "blind" else image.depth_m
        return RGBD(image.colour, depth_m if depth else None, LENS, time.monotonic() - 5 * (kind == "stale"))


class EmulatedGel(FakeVideoDevice):
    """A gel with a blob where it touches. A trouble lasts a while from when it begins."""

    LASTS_S = 0.3

    def __init__(self, world, finger):
        self.world, self.finger, self._trouble = world, finger, (None, 0.0)
        super().__init__(fps=100.0, size=(32, 24), phase_s=0.003 * (finger == "b"))
        self.rng = np.random.default_rng([8, world.seed, ord(finger)])

    def begin_trouble(self):
        """Now and then; called once an attempt for its three pictures."""
        for _ in range(3):
            if kind := self.world.fault(f"gel {self.finger}", "unplugged", "frozen", "damaged"):
                self._trouble = (kind, time.monotonic() + self.LASTS_S)

    def _has(self, kind):
        return self._trouble[0] == kind and time.monotonic() < self._trouble[1]

    dead = property(lambda self: self._has("unplugged"), lambda self, value: None)
    frozen = property(lambda self: self._has("frozen"), lambda self, value: None)
    damaged = property(lambda self: int(self._has("damaged")), lambda self, value: None)

    def picture(self, number):
        if self.frozen and self._last is not None:
            return self._last
        image = np.full((24, 32, 3), 90.0) + self.rng.normal(0, 2, (24, 32, 3))
        if self.world.holding:
            size = 2 + int(self.world.emulator.force_limit_n / 8)
            image[max(0, 12 - size) : 12 + size, max(0, 16 - size) : 16 + size] += [20, -40, 60]
        self._last = np.clip(image, 0, 255).astype(np.uint8)
        return self._last

    _last = None


class EmulatedRig(Rig):
    """The rig. Objects are cylinders by name, placed at random for each attempt; now and then one slips."""

    def __init__(self, url, world, gels, arm, **gripper):
        self.world, self.gels = world, gels
        quick = {"timeout_s": 0.25, "reconnect_s": 0.02, "acknowledge_faults": True, "max_speed_mm_s": 400.0}
        super().__init__(
            arm,
            WatchedWSG50(world, port=url, **quick | gripper),
            {
                finger: OpencvTactile(finger=finger, device=gel_path(finger), warmup_s=0.0, timeout_s=1.0, frozen_s=0.2)
                for finger in gels
            },
            EmulatedCamera(world),
            info={"source": "emulated rig", "sensor": "emulated gel"},
            attempt=QUICK,
        )

    def prepare(self, object_id, number):
        world, name = self.world, zlib.crc32(object_id.encode())
        rng = np.random.default_rng([2, world.seed, name, number])
        radius, height = np.random.default_rng([1, name]).uniform((18, 60), (40, 140))
        x, y = rng.uniform(-20, 20, 2)
        world.solid = views.UprightCylinder(float(radius), float(height), float(x), float(y))
        world.slips, world.noise = bool(rng.uniform() < 0.1), int(rng.integers(2**31))
        world.hand_at(world.pose)
        for gel in self.gels.values():
            gel.begin_trouble()


def gel_path(finger):
    """What stands for a stable name of the finger's camera."""
    return f"/dev/v4l/by-id/usb-Emulated_Gel_{finger}-video-index0"


@contextlib.contextmanager
def emulated_rig(seed=0, *, port="tcp", arm="at once", rate=0.0, **gripper):
    """An EmulatedRig, not connected, whose devices are there as long as this is open."""
    world = EmulatedRigState(seed, rate)
    gels = {finger: EmulatedGel(world, finger) for finger in "ab"}
    by_path = {gel_path(finger): gel for finger, gel in gels.items()}
    with (
        SERVERS[port](world.emulator, world.line) as url,
        ARMS[arm](world) as hand,
        patch.object(opencv_stream, "open_capture", lambda device: by_path[device].open(device)),
    ):
        yield EmulatedRig(url, world, gels, hand, **gripper)


@dataclass
class Outcome:
    """What came of a collection among faults."""

    grasps: int
    attempts: int
    stops: list[str]
    faults: Counter
    left_moving: int
    left_holding: int

    def lines(self):
        yield f"{self.grasps} whole grasps of {self.attempts} attempts; stopped {len(self.stops)} times"
        yield from (f"  stopped: {reason}" for reason in self.stops)
        yield f"jaws left moving: {self.left_moving} times; left closed on something: {self.left_holding} times"
        yield from (f"{count:6} {kind}" for kind, count in sorted(self.faults.items()))


def collect_among_faults(out, grasps, *, rate=0.02, seed=0, port="tcp", arm="at once", objects=5):
    """Collect `grasps` accepted ones with faults at every device; begun again, as a person would, where it stops."""
    found = Outcome(0, 0, [], Counter(), 0, 0)
    names = [f"can-{number}" for number in range(objects)]
    given = {"objects": names, "seed": seed, "settings": CollectSettings(grasps // objects)}
    while not found.grasps:
        with emulated_rig(seed + len(found.stops), port=port, arm=arm, rate=rate) as rig:
            try:
                tallies = collect(lambda rig=rig: rig, out, **given)
                found.grasps = sum(tally.accepted for tally in tallies)
                found.attempts = sum(tally.attempts for tally in tallies)
            except DeviceError as error:
                found.stops.append(str(error))
            found.left_moving += rig.world.left_moving
            found.left_holding += rig.world.emulator.grasping == HOLDING
            found.faults += Counter(rig.world.all_counts)
    return found


def broken_images(folder):
    """Pictures of a recording that are missing or do not decode."""
    paths = [folder / path for grasp in read_recording(folder).grasps for path in grasp.images().values()]
    return [path for path in paths if not path.is_file() or cv2.imread(str(path)) is None]


def main():
    """Print what was collected and every fault by kind; the recording is read again whole."""
    parser = argparse.ArgumentParser(prog="python -m tests.emulated_rig", description=main.__doc__)
    parser.add_argument("--grasps", type=int, default=500)
    parser.add_argument("--rate", type=float, default=0.02, help="share of operations that meet a fault")
    parser.add_argument("--port", choices=sorted(SERVERS), default="tcp")
    parser.add_argument("--arm", choices=sorted(ARMS), default="at once")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="recording folder")
    given = parser.parse_args()
    logging.disable(logging.WARNING)  # one for each fault
    found = collect_among_faults(
        given.out, given.grasps, rate=given.rate, seed=given.seed, port=given.port, arm=given.arm
    )
    print("\n".join(found.lines()))
    grasps = read_recording(given.out).grasps
    print(f"{len(grasps)} grasps in {given.out}, {len(broken_images(given.out))} of their pictures broken")


if __name__ == "__main__":
    main()
