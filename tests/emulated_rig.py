"""A rig with the real drivers and emulated devices that have one common state.

The gripper's driver is connected to an emulated WSG-50 over TCP, the gels' driver to computed
cameras through OpenCV's interface. The arm, which reaches its target at once, and the camera are from this file. The
gripper's line, the arm and the camera can have faults.
"""

import contextlib
import time
import zlib
from unittest.mock import patch

import numpy as np

from robot.devices import Arm, Camera, VirtualDevice
from robot.drivers.usb_camera import stream as opencv_stream
from robot.drivers.usb_camera.driver import OpencvTactile
from robot.drivers.wsg50.driver import WSG50
from robot.grasping.settings import AttemptSettings, GraspSettings
from robot.readings import RGBD, Pose
from robot.rig import Rig
from tests import views
from tests.emulators.wsg50.faults import LineFaults
from tests.emulators.wsg50.gripper import HOLDING, EmulatedWSG50
from tests.emulators.wsg50.server import serve
from tests.fake_rig import LENS, PX, WORKSPACE, chord
from tests.fake_video import FakeVideoDevice

FRAMES = 4
"""Packets per operation of the gripper: command, pending, state, result. Each can have a fault."""
QUICK = AttemptSettings(
    GraspSettings(lift_mm=100.0), settle_s=0.1, hold_s=0.1, travel_mm_s=1000.0, closing_mm_s=400.0, retries=4
)


class EmulatedRigState:
    """State of all devices. `rate` is the fraction of operations of gripper, arm and camera with a fault."""

    def __init__(self, seed, rate):
        self.seed, self.rate, self.faults = seed, rate, 0
        self.rng = np.random.default_rng([7, seed])
        self.emulator = EmulatedWSG50(speed_up=50.0, referenced=True)
        self.line = LineFaults(rate / FRAMES, seed=seed)
        self.pose, self.solid, self.noise = Pose(0, 0, 300, 0), None, 0

    def may_fail(self):
        if self.rng.uniform() < self.rate:
            self.faults += 1
            raise OSError(104, "Connection reset by peer")

    @property
    def holding(self):
        return self.emulator.grasping == HOLDING and self.emulator.object_mm is not None

    def hand_at(self, pose):
        """Set the pose of the hand. A held object moves along; otherwise the jaws enclose what is at the new pose."""
        self.pose = pose
        if not self.holding:
            self.emulator.object_mm = (chord(pose, self.solid) or None) if self.solid else None


class EmulatedArm(VirtualDevice, Arm):
    """An arm that reaches its target at once, unless it fails."""

    def __init__(self, shared):
        super().__init__("emulated arm", WORKSPACE)
        self.shared = shared

    def _move_to(self, pose, speed_mm_s):
        self.shared.may_fail()
        self.shared.hand_at(pose)
        return pose

    def _pose(self):
        return self.shared.pose


class EmulatedCamera(VirtualDevice, Camera):
    """A camera that shows the cylinder on the table."""

    def __init__(self, shared):
        super().__init__("emulated camera", views.camera_pose())
        self.shared = shared

    def _read(self, depth):
        shared = self.shared
        shared.may_fail()
        image = views.view(*([shared.solid] if shared.solid else []), seed=shared.noise, lens=LENS, px=PX)
        return RGBD(image.colour, image.depth_m if depth else None, LENS, time.monotonic())


class EmulatedGel(FakeVideoDevice):
    """A gel with a blob at the contact."""

    def __init__(self, shared, finger):
        super().__init__(fps=100.0, size=(32, 24))
        self.shared, self.rng = shared, np.random.default_rng([8, shared.seed, ord(finger)])

    def picture(self, number):
        image = np.full((24, 32, 3), 90.0) + self.rng.normal(0, 2, (24, 32, 3))
        if self.shared.holding:
            size = 2 + int(self.shared.emulator.force_limit_n / 8)
            image[max(0, 12 - size) : 12 + size, max(0, 16 - size) : 16 + size] += [20, -40, 60]
        return np.clip(image, 0, 255).astype(np.uint8)


class EmulatedRig(Rig):
    """The rig. Objects are cylinders by name with a random position for each attempt."""

    def __init__(self, port, shared, paths):
        self.shared = shared
        quick = {"timeout_s": 1.0, "acknowledge_faults": True, "max_speed_mm_s": 400.0}
        gel = {"warmup_s": 0.0, "timeout_s": 1.0, "frozen_s": 0.2}
        super().__init__(
            EmulatedArm(shared),
            WSG50(host="127.0.0.1", port=port, **quick),
            {finger: OpencvTactile(finger=finger, device=path, **gel) for finger, path in paths.items()},
            EmulatedCamera(shared),
            info={"source": "emulated rig", "sensor": "emulated gel"},
            attempt=QUICK,
        )

    def prepare(self, object_id, number):
        shared, name = self.shared, zlib.crc32(object_id.encode())
        rng = np.random.default_rng([2, shared.seed, name, number])
        radius, height = np.random.default_rng([1, name]).uniform((18, 60), (40, 140))
        x, y = rng.uniform(-20, 20, 2)
        shared.solid = views.UprightCylinder(float(radius), float(height), float(x), float(y))
        shared.noise = int(rng.integers(2**31))
        shared.hand_at(shared.pose)


@contextlib.contextmanager
def emulated_rig(seed=0, *, rate=0.0):
    """Yield an EmulatedRig, not connected; its devices exist while the context is open."""
    shared = EmulatedRigState(seed, rate)
    paths = {finger: f"/dev/v4l/by-id/usb-Emulated_Gel_{finger}-video-index0" for finger in "ab"}
    gels = {path: EmulatedGel(shared, finger) for finger, path in paths.items()}
    with (
        serve(shared.emulator, shared.line) as port,
        patch.object(opencv_stream, "open_capture", lambda device: gels[device].open(device)),
    ):
        yield EmulatedRig(port, shared, paths)
