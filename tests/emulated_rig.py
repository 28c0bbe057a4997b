"""A rig with the real drivers and emulated devices that have one common state.

The gripper's driver is connected to an emulated WSG-50 over TCP or a pseudo-terminal, the gels' driver to computed
cameras through OpenCV's interface. The arm, which reaches its target at once, and the camera are from this file. Every
device can have faults, counted by kind.
"""

import contextlib
import math
import time
import zlib
from collections import Counter
from unittest.mock import patch

import numpy as np

from robot.devices import Arm, Camera, VirtualDevice
from robot.drivers.usb_camera import stream as opencv_stream
from robot.drivers.usb_camera.driver import OpencvTactile
from robot.drivers.wsg50.driver import WSG50
from robot.errors import DeviceError
from robot.grasping.settings import AttemptSettings, GraspSettings
from robot.readings import RGBD, Intrinsics, Pose, Region
from robot.rig import Rig
from tests import views
from tests.emulators.wsg50.faults import LineFaults
from tests.emulators.wsg50.gripper import EmulatedWSG50
from tests.emulators.wsg50.server import serve_pty, serve_tcp
from tests.fake_video import FakeVideoDevice

WORKSPACE = Region((-150.0, -150.0, 8.0), (150.0, 150.0, 500.0))
LENS, PX = Intrinsics(120.0, 120.0, 63.5, 53.5), (108, 128)
HOLDING = 4
SPEED_UP = 50.0
FRAMES = 4
"""Packets per operation of the gripper: command, pending, state, result. Each can have a fault."""
QUICK = AttemptSettings(
    GraspSettings(lift_mm=100.0), settle_s=0.1, hold_s=0.1, travel_mm_s=1000.0, closing_mm_s=400.0, retries=4
)
SERVERS = {"tcp": serve_tcp, "pty": serve_pty}


class EmulatedRigState:
    """State of all devices. `rate` is the fraction of operations of arm, camera and gels with a fault."""

    def __init__(self, seed, rate=0.0):
        self.seed, self.rate = seed, rate
        self.rng, self.counts = np.random.default_rng([7, seed]), Counter()
        self.emulator = EmulatedWSG50(speed_up=SPEED_UP, referenced=True)
        self.line = LineFaults(rate / FRAMES, seed=seed)
        self.left_moving = 0
        self.pose, self.solid, self.slips, self.noise = Pose(0, 0, 300, 0), None, False, 0

    def fault(self, device, *kinds):
        """Return the kind of fault of this operation of a device, or None."""
        if not kinds or self.rng.uniform() >= self.rate:
            return None
        kind = str(self.rng.choice(kinds))
        self.counts[f"{device}: {kind}"] += 1
        return kind

    @property
    def holding(self):
        return self.emulator.grasping == HOLDING and self.emulator.object_mm is not None

    def hand_at(self, pose):
        """Set the pose of the hand. A held object moves along; otherwise the jaws enclose what is at the new pose."""
        lifted, self.pose = pose.z_mm > self.pose.z_mm + 1, pose
        if not self.holding:
            self.emulator.object_mm = self._chord(pose)
        elif self.slips and lifted:
            self.emulator.object_mm = None

    def _chord(self, pose):
        """Return the width of the cylinder between the fingers, None if there is nothing."""
        solid = self.solid
        if solid is None or pose.z_mm > solid.height:
            return None
        across = -math.sin(pose.yaw_rad) * (solid.x - pose.x_mm) + math.cos(pose.yaw_rad) * (solid.y - pose.y_mm)
        return 2 * math.sqrt(solid.radius**2 - across**2) if abs(across) < solid.radius else None


class EmulatedArm(VirtualDevice, Arm):
    """An arm that reaches its target at once, unless it fails."""

    def __init__(self, shared):
        super().__init__("emulated arm", WORKSPACE)
        self.shared = shared

    def _move_to(self, pose, speed_mm_s):
        kind = self.shared.fault("arm", "did not arrive", "link lost")
        if kind == "link lost":
            raise OSError(104, "Connection reset by peer")
        if kind:
            raise DeviceError("the emulated arm must arrive within 5 s, it is 40 mm off")
        self.shared.hand_at(pose)
        return pose

    def _pose(self):
        return self.shared.pose


class WatchedWSG50(WSG50):
    """The driver of the gripper; the common state counts calls that return or fail with moving jaws."""

    def __init__(self, shared, **settings):
        super().__init__(**settings)
        self.shared = shared

    @contextlib.contextmanager
    def _moving(self, failure):
        try:
            with super()._moving(failure):
                yield
        finally:
            self.shared.left_moving += self.shared.emulator.moves

    def _close(self):
        try:
            super()._close()
        finally:
            self.shared.left_moving += self.shared.emulator.moves


class EmulatedCamera(VirtualDevice, Camera):
    """A camera that shows the cylinder on the table."""

    def __init__(self, shared):
        super().__init__("emulated camera", views.camera_pose())
        self.shared = shared

    def _read(self, depth):
        kind = self.shared.fault("camera", "unplugged", "stale", "blind")
        if kind == "unplugged":
            raise OSError(19, "No such device")
        shared = self.shared
        image = views.view(*([shared.solid] if shared.solid else []), seed=shared.noise, lens=LENS, px=PX)
        depth_m = np.full(PX, np.nan, np.float32) if kind == "blind" else image.depth_m
        return RGBD(image.colour, depth_m if depth else None, LENS, time.monotonic() - 5 * (kind == "stale"))


class EmulatedGel(FakeVideoDevice):
    """A gel with a blob at the contact. A fault lasts `LASTS_S`."""

    LASTS_S = 0.3

    def __init__(self, shared, finger):
        self.shared, self.finger, self._trouble = shared, finger, (None, 0.0)
        super().__init__(fps=100.0, size=(32, 24), phase_s=0.003 * (finger == "b"))
        self.rng = np.random.default_rng([8, shared.seed, ord(finger)])

    def begin_trouble(self):
        """Start faults at random; called once per attempt for its three pictures."""
        for _ in range(3):
            if kind := self.shared.fault(f"gel {self.finger}", "unplugged", "frozen", "damaged"):
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
        if self.shared.holding:
            size = 2 + int(self.shared.emulator.force_limit_n / 8)
            image[max(0, 12 - size) : 12 + size, max(0, 16 - size) : 16 + size] += [20, -40, 60]
        self._last = np.clip(image, 0, 255).astype(np.uint8)
        return self._last

    _last = None


class EmulatedRig(Rig):
    """The rig. Objects are cylinders by name with a random position for each attempt; some slip."""

    def __init__(self, url, shared, gels):
        self.shared, self.gels = shared, gels
        quick = {"timeout_s": 0.25, "reconnect_s": 0.02, "acknowledge_faults": True, "max_speed_mm_s": 400.0}
        super().__init__(
            EmulatedArm(shared),
            WatchedWSG50(shared, port=url, **quick),
            {
                finger: OpencvTactile(finger=finger, device=gel_path(finger), warmup_s=0.0, timeout_s=1.0, frozen_s=0.2)
                for finger in gels
            },
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
        shared.slips, shared.noise = bool(rng.uniform() < 0.1), int(rng.integers(2**31))
        shared.hand_at(shared.pose)
        for gel in self.gels.values():
            gel.begin_trouble()


def gel_path(finger):
    """Return a stable path of the finger's camera."""
    return f"/dev/v4l/by-id/usb-Emulated_Gel_{finger}-video-index0"


@contextlib.contextmanager
def emulated_rig(seed=0, *, port="tcp", rate=0.0):
    """Yield an EmulatedRig, not connected; its devices exist while the context is open."""
    shared = EmulatedRigState(seed, rate)
    gels = {finger: EmulatedGel(shared, finger) for finger in "ab"}
    by_path = {gel_path(finger): gel for finger, gel in gels.items()}
    with (
        SERVERS[port](shared.emulator, shared.line) as url,
        patch.object(opencv_stream, "open_capture", lambda device: by_path[device].open(device)),
    ):
        yield EmulatedRig(url, shared, gels)
