"""A computed rig: cylinders on a table, one-sided depth, gels with a blob at the contact. It is fast and exact.

An attempt is a pure function of (seed, object, number). Devices can have faults, to test a collector without hardware.
"""

import math
import zlib

import numpy as np

from robot.devices import Arm, Camera, Gripper, TactileSensor
from robot.errors import DeviceError
from robot.readings import RGBD, Frame, GripperState, Intrinsics, Pose, Region
from robot.rig import Rig
from tests import views

WORKSPACE = Region((-150.0, -150.0, 8.0), (150.0, 150.0, 500.0))
LENS, PX = Intrinsics(120.0, 120.0, 63.5, 53.5), (108, 128)
STROKE_MM, FORCE_N = 110.0, (5.0, 80.0)


def chord(pose, solid):
    """Return the width of a standing cylinder between the fingers, 0 for a miss."""
    across = -math.sin(pose.yaw_rad) * (solid.x - pose.x_mm) + math.cos(pose.yaw_rad) * (solid.y - pose.y_mm)
    if pose.z_mm > solid.height or abs(across) >= solid.radius:
        return 0.0
    return 2 * math.sqrt(solid.radius**2 - across**2)


class FakeRigState:
    """State of all devices."""

    def __init__(self, seed):
        self.seed, self.now_s = seed, 0.0
        self.pose, self.opening, self.force = Pose(0, 0, 300, 0), STROKE_MM, None
        self.solid, self.grip_at, self.slips = None, None, False
        self.calls, self.faults = [], {}

    def clock(self):
        return self.now_s

    def sleep(self, seconds):
        self.now_s += seconds

    def record_call(self, name):
        """Record a call and fail on purpose: `faults` maps a call to the numbers of its failures."""
        self.calls.append(name)
        if self.calls.count(name) in self.faults.get(name, ()):
            raise DeviceError(f"the fake {name} fails on purpose")

    def status(self):
        if self.force is None:
            return "idle"
        if chord(self.grip_at, self.solid) == 0.0:
            return "no_part"
        return "part_lost" if self.slips and self.pose.z_mm > self.grip_at.z_mm + 1 else "holding"


class FakeRig(Rig):
    """The rig. Names set the shape of objects: "round-7", "wide-1" (wider than the stroke), "thin-2" (often missed)."""

    can_run_jobs = True

    def __init__(self, seed=0, *, fingers=("a", "b"), faults=None):
        self.shared = FakeRigState(seed)
        self.shared.faults = {} if faults is None else faults
        super().__init__(
            FakeArm(self.shared),
            FakeGripper(self.shared),
            {finger: FakeSensor(self.shared, finger) for finger in fingers},
            FakeCamera(self.shared),
            info={"source": "fake rig", "sensor": "fake gel", "rig": "fake"},
            clock=self.shared.clock,
            sleep=self.shared.sleep,
        )

    def object_ids(self, count):
        return [f"round-{number}" for number in range(count)]

    def prepare(self, object_id, number):
        shared, kind = self.shared, object_id.split("-")[0]
        shape = np.random.default_rng([1, zlib.crc32(object_id.encode())])
        radius = {"round": shape.uniform(18, 40), "wide": 70.0, "thin": 9.0, "none": 1e-3}[kind]
        rng = np.random.default_rng([2, shared.seed, zlib.crc32(object_id.encode()), number])
        x, y = rng.uniform(-20, 20, 2)
        shared.solid = views.UprightCylinder(radius, shape.uniform(60, 140), float(x), float(y))
        shared.slips, shared.noise = bool(rng.uniform() < 0.2), int(rng.integers(2**31))
        shared.force, shared.now_s = None, 100.0 * number


class FakeDevice:
    """Records the calls that all devices have."""

    def _record(self, what):
        self.shared.record_call(f"{self.name.removeprefix('fake ')}.{what}")

    def _connect(self):
        self._record("connect")

    def _close(self):
        self._record("close")

    def _stop(self):
        self._record("stop")


class FakeArm(FakeDevice, Arm):
    def __init__(self, shared):
        super().__init__("fake arm", WORKSPACE, clock=shared.clock)
        self.shared = shared

    def _move_to(self, pose, speed_mm_s):
        self.shared.record_call("arm")
        self.shared.sleep(math.dist(self.shared.pose.as_tuple()[:3], pose.as_tuple()[:3]) / speed_mm_s)
        self.shared.pose = pose
        return pose

    def _pose(self):
        return self.shared.pose


class FakeGripper(FakeDevice, Gripper):
    def __init__(self, shared):
        low, high = FORCE_N
        super().__init__("fake gripper", stroke_mm=STROKE_MM, min_force_n=low, max_force_n=high, clock=shared.clock)
        self.shared = shared

    def _settings(self):
        return {"stroke_mm": self.stroke_mm}

    def _state(self):
        shared = self.shared
        status = shared.status()
        opening = shared.opening if status == "idle" else chord(shared.grip_at, shared.solid)
        return GripperState(opening, shared.force or 0.0, status)

    def _open(self, opening_mm):
        self.shared.record_call("open")
        self.shared.opening, self.shared.force = opening_mm, None
        return self._state()

    def _grasp(self, force_n, speed_mm_s):
        self.shared.record_call("grasp")
        self.shared.grip_at, self.shared.force = self.shared.pose, force_n
        self.shared.sleep(self.shared.opening / speed_mm_s)
        return self._state()


class FakeSensor(FakeDevice, TactileSensor):
    def __init__(self, shared, finger):
        super().__init__(f"fake gel {finger}", finger, clock=shared.clock)
        self.shared = shared

    def _read(self):
        shared = self.shared
        shared.record_call(f"gel {self.finger}")
        touching = shared.status() == "holding"
        rng = np.random.default_rng([3, shared.noise, ord(self.finger), touching])
        image = np.full((24, 32, 3), 90.0) + rng.normal(0, 2, (24, 32, 3))
        if touching:
            size = 2 + int(shared.force / 8)
            image[12 - size : 12 + size, 16 - size : 16 + size] += [60, -40, 20]
        return Frame(np.clip(image, 0, 255).astype(np.uint8), shared.now_s)


class FakeCamera(FakeDevice, Camera):
    def __init__(self, shared):
        super().__init__("fake camera", views.camera_pose(), clock=shared.clock)
        self.shared = shared

    def _read(self, depth):
        shared = self.shared
        shared.record_call("depth" if depth else "camera")
        image = views.view(shared.solid, seed=shared.noise, lens=LENS, px=PX)
        return RGBD(image.colour, image.depth_m if depth else None, LENS, shared.now_s)
