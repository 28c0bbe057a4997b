"""`retrieve rig check`: connect one device of a rig after another, move it a little, and report measurements.

All devices are checked, also after one has failed. Nothing is grasped. The jaws move by `JAW_MM`, the arm moves up by
`ARM_MM` (down, at the top of the workspace), and both return. Connecting may enable the motors of an arm, and may home
a gripper without reference over its whole stroke. With motion=False, nothing moves.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from robot.devices import Device, TactileSensor, read_together
from robot.errors import RobotError
from robot.readings import RGBD, Frame
from robot.rig import Rig

JAW_MM, ARM_MM, ARM_MM_S = 5.0, 10.0, 20.0
MEASURE_S = 2.0
"""Duration of the frame rate measurement in s."""

_POLL_S = 0.002
_REPEATS = 20
"""Number of state queries for the response time, and of paired gel reads for the skew."""


@dataclass(frozen=True)
class DeviceReport:
    """Result of the check of one device.

    Attributes:
        device: Name of the device.
        role: "arm", "gripper", "gel", "camera" or "skew".
        measured: Measured figures by name, as text with units.
        refused: Settings that the device refused, each with the requested and the actual value.
        failure: Error message, or None if the device works.
    """

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
    """Check each device, then the time skew between the fingers' frames; yield one report for each.

    A device error becomes the `failure` of its report.

    Args:
        rig: The rig, not connected.
        motion: Whether arm and jaws may move; if true, connecting may home the gripper.
    """
    rig.arm.may_move = rig.gripper.may_move = motion
    if rig.can_run_jobs:  # a simulated rig needs an object for its gel images
        rig.prepare(rig.object_ids(1)[0], 0)
    yield _check_device([rig.arm], "arm", lambda: _check_arm(rig, motion))
    yield _check_device([rig.gripper], "gripper", lambda: _check_gripper(rig, motion))
    for sensor in rig.sensors.values():
        yield _check_device([sensor], "gel", partial(_check_sensor, rig, sensor))
    yield _check_device([rig.camera], "camera", lambda: _check_camera(rig))
    if len(rig.sensors) > 1:
        yield _check_device(list(rig.sensors.values()), "skew", lambda: _check_skew(rig))


def _check_device(devices: Sequence[Device], role: str, check: Callable[[], dict[str, str]]) -> DeviceReport:
    row = DeviceReport(" and ".join(device.name for device in devices), role)
    try:
        with contextlib.ExitStack() as connected:
            for device in devices:
                connected.enter_context(device)
            refused = dict(devices[0].refused) if len(devices) == 1 else {}
            row = replace(row, measured=check(), refused=refused)
    except RobotError as error:  # also if a person must act and there is no terminal
        return replace(row, failure=str(error))
    return row


def _check_arm(rig: Rig, motion: bool) -> dict[str, str]:
    """Move the arm up a little (down, at the top of the workspace), and back."""
    arm = rig.arm
    if arm.is_manual:
        return {"moved": "by a person"}
    if not motion:
        return {"moved": "not"} | _round_trip(rig, arm.pose)
    start = arm.pose()
    top = arm.workspace.upper[2]
    target = replace(start, z_mm=start.z_mm + ARM_MM if start.z_mm + ARM_MM <= top else start.z_mm - ARM_MM)
    speed, began = min(ARM_MM_S, arm.max_speed_mm_s), rig.clock()
    reached = arm.move_to(target, speed)
    seconds = rig.clock() - began
    arm.move_to(start, speed)
    away = np.linalg.norm(np.subtract(reached.as_tuple()[:3], target.as_tuple()[:3]))
    return {"moved": f"{ARM_MM:g} mm in {seconds:.2f} s", "off by": f"{away:.2f} mm"} | _round_trip(rig, arm.pose)


def _check_gripper(rig: Rig, motion: bool) -> dict[str, str]:
    gripper = rig.gripper
    state = gripper.state()
    measured = {"status": state.status, "opening": f"{state.opening_mm:.2f} mm"} | _round_trip(rig, gripper.state)
    measured["force"] = f"{gripper.min_force_n:g} to {gripper.max_force_n:g} N on each finger"
    if motion and state.status == "idle":
        target_mm = state.opening_mm - JAW_MM if state.opening_mm >= JAW_MM else state.opening_mm + JAW_MM
        reached = gripper.open(target_mm)
        gripper.open(min(state.opening_mm, gripper.stroke_mm))
        measured["moved"] = f"{JAW_MM:g} mm, off by {abs(reached.opening_mm - target_mm):.2f} mm"
    elif motion:
        measured["moved"] = f"not: it is {state.status}"
    return measured


def _round_trip(rig: Rig, query: Callable[[], Any]) -> dict[str, str]:
    times = []
    for _ in range(_REPEATS):
        began = rig.clock()
        query()
        times.append(rig.clock() - began)
    return {"state in": f"{1000 * median(times):.2f} ms (slowest {1000 * max(times):.2f})"}


def _check_sensor(rig: Rig, sensor: TactileSensor) -> dict[str, str]:
    frame, measured = _measure_frames(rig, sensor.read)
    return measured | _size(frame.pixels)


def _check_camera(rig: Rig) -> dict[str, str]:
    camera = rig.camera
    image, measured = _measure_frames(rig, lambda: camera.read(depth=camera.has_depth))
    measured |= _size(image.colour)
    if image.depth_m is not None:
        known = np.isfinite(image.depth_m)
        middle = f", median {np.nanmedian(image.depth_m):.3f} m" if known.any() else ""
        measured["depth known"] = f"{known.mean():.0%} of the pixels{middle}"
    return measured


def _size(pixels: npt.NDArray[np.uint8]) -> dict[str, str]:
    return {"size": f"{pixels.shape[1]} x {pixels.shape[0]}", "mean grey level": f"{pixels.mean():.0f}"}


_Picture = TypeVar("_Picture", Frame, RGBD)


def _measure_frames(rig: Rig, read: Callable[[], _Picture]) -> tuple[_Picture, dict[str, str]]:
    """Read frames for `MEASURE_S`; return the last one, with the rate of new frames and their median age."""
    times, ages, began = set(), [], rig.clock()
    while True:
        frame = read()
        times.add(frame.time_s)
        ages.append(rig.clock() - frame.time_s)
        if rig.clock() - began >= MEASURE_S:
            break
        rig.sleep(_POLL_S)
    rate = f"{len(times)} frame(s) in {MEASURE_S:g} s"
    if len(times) > 1:  # from the first frame to the last, so the phase of the measurement has no effect
        rate = f"{(len(times) - 1) / (max(times) - min(times)):.1f} frames/s"
    return frame, {"rate": rate, "age": f"{1000 * median(ages):.0f} ms"}


def _check_skew(rig: Rig) -> dict[str, str]:
    """Measure the skew between all gels, read as the collector reads them."""
    skews = []
    for _ in range(_REPEATS):
        skews.append(read_together(rig.sensors)[1])
        rig.sleep(0.05)
    return {"apart": f"{1000 * median(skews):.1f} ms (max {1000 * max(skews):.1f})"}
