"""`retrieve rig check`: connect one device of a rig after another, move it a little, and report measurements.

All devices are checked, also after one has failed. Nothing is grasped. The jaws move by `JAW_MM`, the arm moves up by
`ARM_MM` (down, at the top of the workspace), and both return. Connecting may enable the motors of an arm. A gripper
that has lost its reference may be homed: its jaws then move over the whole stroke. With motion=False, nothing moves.
"""

import contextlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt

from robot.devices import Camera, Device, TactileSensor, read_together
from robot.drivers.discover import usb_port
from robot.errors import DeviceError, RobotError
from robot.rig import Rig

JAW_MM, ARM_MM, ARM_MM_S = 5.0, 10.0, 20.0
MEASURE_S = 2.0
"""Duration of the frame rate measurement in s."""

MIN_SHARE = 0.8
"""Smallest accepted rate of a camera while all cameras are read, as a fraction of its rate when it is read alone."""

_POLL_S = 0.002
_REPEATS = 20
"""Number of state queries for the response time, and of paired gel reads for the skew."""


@dataclass(frozen=True)
class DeviceReport:
    """Result of the check of one device.

    Attributes:
        device: Name of the device.
        role: "arm", "gripper", "gel", "camera", "together" (all cameras at the same time) or "skew".
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
    """Check each device, then all cameras together and the time skew between the fingers' frames; yield the reports.

    A RobotError of a check becomes the `failure` of its report.

    Args:
        rig: The rig, not connected.
        motion: Whether arm and jaws may move; if true, connecting may home the gripper.
    """
    rig.arm.may_move = rig.gripper.may_move = motion
    if rig.can_run_jobs:  # a simulated rig needs an object for its gel images
        rig.prepare(rig.object_ids(1)[0], 0)
    yield _check_device([rig.arm], "arm", lambda: _check_arm(rig, motion))
    yield _check_device([rig.gripper], "gripper", lambda: _check_gripper(rig, motion))
    alone: dict[str, float] = {}
    for sensor in rig.sensors.values():
        yield _check_device([sensor], "gel", partial(_check_sensor, rig, sensor, alone))
    yield _check_device([rig.camera], "camera", lambda: _check_camera(rig, alone))
    if not rig.can_run_jobs:  # simulated cameras share no cable
        yield _check_device(_cameras(rig), "together", lambda: _check_together(rig, alone))
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
    except RobotError as error:
        return replace(row, failure=str(error))
    return row


def _check_arm(rig: Rig, motion: bool) -> dict[str, str]:
    """Move the arm up a little (down, at the top of the workspace), and back."""
    arm = rig.arm
    if arm.is_manual:
        return {"moved": "by a person"}
    if not motion:
        return {"motion": "none"} | _round_trip(rig, arm.pose)
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
        measured["motion"] = f"none, because it is {state.status}"
    return measured


def _round_trip(rig: Rig, query: Callable[[], Any]) -> dict[str, str]:
    times = []
    for _ in range(_REPEATS):
        began = rig.clock()
        query()
        times.append(rig.clock() - began)
    return {"answer to a query in": f"{1000 * median(times):.2f} ms (slowest {1000 * max(times):.2f})"}


def _check_sensor(rig: Rig, sensor: TactileSensor, alone: dict[str, float]) -> dict[str, str]:
    watched = _watch_frames(rig, [sensor])[0]
    return _describe_frames(watched, alone) | _size(watched.picture.pixels)


def _check_camera(rig: Rig, alone: dict[str, float]) -> dict[str, str]:
    watched = _watch_frames(rig, [rig.camera])[0]
    image = watched.picture
    measured = _describe_frames(watched, alone) | _size(image.colour)
    if image.depth_m is not None:
        known = np.isfinite(image.depth_m)
        middle = f", median {np.nanmedian(image.depth_m):.3f} m" if known.any() else ""
        measured["depth known"] = f"{known.mean():.0%} of the pixels{middle}"
    return measured


def _size(pixels: npt.NDArray[np.uint8]) -> dict[str, str]:
    return {"size": f"{pixels.shape[1]} x {pixels.shape[0]}", "mean grey level": f"{pixels.mean():.0f}"}


@dataclass
class _WatchedFrames:
    """The frames of one camera during a measurement.

    Attributes:
        device: The camera or gel.
        times_s: Times of the frames.
        ages_s: Age of the newest frame at each read.
        picture: The last frame.
    """

    device: Camera | TactileSensor
    times_s: set[float] = field(default_factory=set)
    ages_s: list[float] = field(default_factory=list)
    picture: Any = None

    @property
    def rate_hz(self) -> float:
        """Number of frames after the first, divided by the time from the first to the last; 0 without two frames.

        Time before the first frame and after the last one is not counted, because it depends on the moments at which
        the measurement starts and ends.
        """
        if len(self.times_s) < 2:
            return 0.0
        return (len(self.times_s) - 1) / (max(self.times_s) - min(self.times_s))

    @property
    def dropped(self) -> int:
        """Estimated number of dropped frames: a gap of n median intervals counts as n - 1 frames."""
        intervals = np.diff(sorted(self.times_s))
        return int(np.sum(np.rint(intervals / np.median(intervals)) - 1)) if len(intervals) else 0


def _watch_frames(rig: Rig, devices: Sequence[Camera | TactileSensor]) -> list[_WatchedFrames]:
    """Read the newest frames of all cameras at the same time for `MEASURE_S`."""
    watched, began = [_WatchedFrames(device) for device in devices], rig.clock()
    while True:
        for each in watched:
            device = each.device
            picture = device.read(depth=device.has_depth) if isinstance(device, Camera) else device.read()
            each.picture = picture
            each.times_s.add(picture.time_s)
            each.ages_s.append(rig.clock() - picture.time_s)
        if rig.clock() - began >= MEASURE_S:
            break
        rig.sleep(_POLL_S)
    return watched


def _describe_frames(watched: _WatchedFrames, alone: dict[str, float]) -> dict[str, str]:
    """Return rate, dropped and repeated frames, age and USB socket as text; note the rate in `alone`."""
    device, settings = watched.device, watched.device.settings()
    alone[device.name] = watched.rate_hz
    rate = (
        f"{watched.rate_hz:.1f} frames/s" if watched.rate_hz else f"{len(watched.times_s)} frame(s) in {MEASURE_S:g} s"
    )
    promised = {"promised": f"{settings['fps']:g} frames/s"} if settings.get("fps") else {}
    measured = {"rate": rate, **promised, "dropped": str(watched.dropped)}
    measured["age"] = f"{1000 * median(watched.ages_s):.0f} ms"
    if (port := usb_port(str(settings.get("device", "")))) is not None:
        measured["USB"] = str(port)
    return measured


def _check_together(rig: Rig, alone: Mapping[str, float]) -> dict[str, str]:
    """Measure the rates of all cameras at the same time; raise DeviceError if one is much slower than alone."""
    watched = _watch_frames(rig, _cameras(rig))
    buses: dict[int, list[tuple[str, int]]] = defaultdict(list)
    for each in watched:
        if (port := usb_port(str(each.device.settings().get("device", "")))) is not None:
            buses[port.bus].append((each.device.name, port.mbit_s))
    shared = [
        f"{' and '.join(name for name, _ in members)} share USB bus {bus} ({max(speed for _, speed in members)} Mbit/s)"
        for bus, members in buses.items()
        if len(members) > 1
    ]
    slow = [
        f"{each.device.name} {each.rate_hz:.1f} frames/s, alone {alone[each.device.name]:.1f}"
        for each in watched
        if each.rate_hz < MIN_SHARE * alone.get(each.device.name, 0.0)
    ]
    if slow:
        raise DeviceError(
            f"with all cameras, frames are lost: {'; '.join([*slow, *shared])}. Connect the cameras to different USB "
            "controllers, or lower width, height or fps"
        )
    rates = {each.device.name: f"{each.rate_hz:.1f} frames/s" for each in watched}
    return rates | ({"shared": "; ".join(shared)} if shared else {})


def _cameras(rig: Rig) -> list[Camera | TactileSensor]:
    return [*rig.sensors.values(), rig.camera]


def _check_skew(rig: Rig) -> dict[str, str]:
    """Measure the skew between all gels, read as the collector reads them."""
    skews = []
    for _ in range(_REPEATS):
        skews.append(read_together(rig.sensors)[1])
        rig.sleep(0.05)
    return {"apart": f"{1000 * median(skews):.1f} ms (max {1000 * max(skews):.1f})"}
