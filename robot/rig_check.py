"""`retrieve rig check`: connect one device of a rig after another, move it a little, and report measurements.

All devices are checked, also after one has failed. Nothing is grasped. The jaws move by `JAW_MM`, the arm moves up by
`ARM_MM` (down, at the top of the workspace), and both return. Connecting may enable the motors of an arm. A gripper
that has lost its reference may be homed: its jaws then move over the whole stroke. With motion=False, nothing moves.
"""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from robot.devices import Camera, Device, TactileSensor, read_together
from robot.errors import RobotError
from robot.rig import Rig

JAW_MM, ARM_MM, ARM_MM_S = 5.0, 10.0, 20.0
MEASURE_S, _POLL_S = 2.0, 0.002
_REPEATS = 20
"""Number of paired gel reads for the skew."""


@dataclass(frozen=True)
class DeviceReport:
    """Result of the check of one device: measured figures, refused settings, and the error message of a failure."""

    device: str
    role: str
    measured: dict[str, str] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    failure: str | None = None

    def line(self) -> str:
        """Return the row of the table."""
        result = self.failure or ", ".join(f"{name} {value}" for name, value in self.measured.items())
        refused = "".join(f"; refused {name}: {value}" for name, value in self.refused.items())
        return f"{'ok  ' if self.failure is None else 'FAIL'}  {self.role:9} {self.device}: {result}{refused}"


def check_rig(rig: Rig, *, motion: bool = True) -> Iterator[DeviceReport]:
    """Check each device of an unconnected rig, then the time skew between the fingers' frames; yield the reports.

    With `motion`, arm and jaws may move, and connecting may home the gripper. A RobotError of a check becomes the
    `failure` of its report.
    """
    rig.arm.may_move = rig.gripper.may_move = motion
    if rig.can_run_jobs:  # a simulated rig needs an object for its gel images
        rig.prepare(rig.object_ids(1)[0], 0)
    sensors = list(rig.sensors.values())
    yield _check("arm", partial(_check_arm, rig, motion), rig.arm)
    yield _check("gripper", partial(_check_gripper, rig, motion), rig.gripper)
    for sensor in sensors:
        yield _check("gel", partial(_check_frames, rig, sensor), sensor)
    yield _check("camera", partial(_check_frames, rig, rig.camera), rig.camera)
    if len(sensors) > 1:
        yield _check("skew", partial(_check_skew, rig), *sensors)


def _check(role: str, measure: Callable[[], dict[str, str]], *devices: Device) -> DeviceReport:
    row = DeviceReport(" and ".join(device.name for device in devices), role)
    try:
        with contextlib.ExitStack() as connected:
            for device in devices:
                connected.enter_context(device)
            refused = dict(devices[0].refused) if len(devices) == 1 else {}
            return replace(row, measured=measure(), refused=refused)
    except RobotError as error:
        return replace(row, failure=str(error))


def _check_arm(rig: Rig, motion: bool) -> dict[str, str]:
    arm = rig.arm
    if arm.is_manual:
        return {"moved": "by a person"}
    start = arm.pose()
    if not motion:
        return {"motion": "none"}
    up_mm = ARM_MM if start.z_mm + ARM_MM <= arm.workspace.upper[2] else -ARM_MM
    target = replace(start, z_mm=start.z_mm + up_mm)
    speed, began = min(ARM_MM_S, arm.max_speed_mm_s), rig.clock()
    reached = arm.move_to(target, speed)
    seconds = rig.clock() - began
    arm.move_to(start, speed)
    off_mm = np.linalg.norm(np.subtract(reached.as_tuple()[:3], target.as_tuple()[:3]))
    return {"moved": f"{ARM_MM:g} mm in {seconds:.2f} s", "off by": f"{off_mm:.2f} mm"}


def _check_gripper(rig: Rig, motion: bool) -> dict[str, str]:
    gripper = rig.gripper
    state = gripper.state()
    measured = {"status": state.status, "opening": f"{state.opening_mm:.2f} mm"}
    measured["force"] = f"{gripper.min_force_n:g} to {gripper.max_force_n:g} N on each finger"
    if motion and state.status == "idle":
        target_mm = state.opening_mm - JAW_MM if state.opening_mm >= JAW_MM else state.opening_mm + JAW_MM
        reached = gripper.open(target_mm)
        gripper.open(min(state.opening_mm, gripper.stroke_mm))
        measured["moved"] = f"{JAW_MM:g} mm, off by {abs(reached.opening_mm - target_mm):.2f} mm"
    elif motion:
        measured["motion"] = f"none, because it is {state.status}"
    return measured


def _check_frames(rig: Rig, device: Camera | TactileSensor) -> dict[str, str]:
    """Read the newest frames of one camera for `MEASURE_S`; the rate is that from its first frame to its last one."""
    times_s, began = set[float](), rig.clock()
    while not times_s or rig.clock() - began < MEASURE_S:
        picture: Any = device.read(depth=device.has_depth) if isinstance(device, Camera) else device.read()
        times_s.add(picture.time_s)
        rig.sleep(_POLL_S)
    measured = {"rate": f"{len(times_s)} frame(s) in {MEASURE_S:g} s"}
    if len(times_s) > 1:
        measured["rate"] = f"{(len(times_s) - 1) / (max(times_s) - min(times_s)):.1f} frames/s"
    if fps := device.settings().get("fps"):
        measured["promised"] = f"{fps:g} frames/s"
    pixels = picture.colour if isinstance(device, Camera) else picture.pixels
    measured |= {"size": f"{pixels.shape[1]} x {pixels.shape[0]}", "mean grey level": f"{pixels.mean():.0f}"}
    if isinstance(device, Camera) and picture.depth_m is not None:
        measured["depth known"] = f"{np.isfinite(picture.depth_m).mean():.0%} of the pixels"
    return measured


def _check_skew(rig: Rig) -> dict[str, str]:
    skews = []
    for _ in range(_REPEATS):
        skews.append(read_together(rig.sensors)[1])
        rig.sleep(0.05)
    return {"apart": f"{1000 * median(skews):.1f} ms"}
