"""The rig of real devices, built from the tables of a TOML file; DRIVERS lists the drivers.

    rig = "real"
    source = "bench 3"                        # written into recording.json
    sensor = "gelsight mini"
    licence = "CC BY 4.0"                     # of the recorded data; default: not stated
    [limits]                                  # upper limits of every commanded motion (Limits)
    workspace_lower_mm = [-150, -150, 10]     # of the point between the fingertips; z = 0 is the table
    workspace_upper_mm = [150, 150, 400]
    [arm]                                     # also [gripper], [sensors.a], [sensors.b]
    driver = "manual"                         # its other keys are settings of the driver
    [camera]
    driver = "realsense"
    hand_eye = "hand_eye.json"                # camera pose in the rig's frame, from `retrieve rig calibrate`
    [gel.a]                                   # known material constants (robot.gel_settings)
    [grasp]                                   # random grasps (robot.grasping.settings.GraspSettings)
    [attempt]                                 # speeds, waits, retries (robot.grasping.settings.AttemptSettings)
    [object]                                  # instead of depth: position and size of every object (ObjectSettings)
    [planner]                                 # the grasp planner (robot.rig)

The limits do not apply to homing, which has the gripper's own speed. A manual arm's limits apply only to the
requested poses and speeds. Sawyer's robot and collision states may be as old as the larger of 2 s and `state_age_s`.
Paths are relative to the working directory.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from _touch_retrieval.documents import Positive, typed
from _touch_retrieval.registry import Registry
from robot.devices import Camera, Device
from robot.errors import RobotConfigError, UnknownName
from robot.gel_settings import parse_gel_settings
from robot.grasping.settings import AttemptSettings, GraspSettings, parse_attempt_settings
from robot.readings import Region
from robot.rig import Rig, ask_on_terminal, load_planner
from robot.settings import TypedSettings, build, build_named
from robot.sight import hand_eye
from robot.sight.cylinder import CylinderFit


def _drivers(role: str, base: str, **table: str) -> "Registry[type[Device]]":
    return Registry(f"[{role}]: driver", "drivers", table, error=UnknownName, base=f"robot.devices:{base}")


DRIVERS: Mapping[str, Registry[type[Device]]] = {
    "arm": _drivers(
        "arm",
        "Arm",
        manual="robot.drivers.manual_arm:ManualArm",
        sawyer="robot.drivers.sawyer.driver:Sawyer",
    ),
    "gripper": _drivers("gripper", "Gripper", wsg50="robot.drivers.wsg50.driver:WSG50"),
    "sensors": _drivers(
        "sensors",
        "TactileSensor",
        gelsight="robot.drivers.usb_camera.driver:GelSight",
        gelsight_mini="robot.drivers.usb_camera.driver:GelSightMini",
        digit="robot.drivers.usb_camera.driver:Digit",
        uvc="robot.drivers.usb_camera.driver:OpencvTactile",
    ),
    "camera": _drivers(
        "camera",
        "Camera",
        realsense="robot.drivers.realsense:RealSense",
        uvc="robot.drivers.usb_camera.driver:UvcCamera",
    ),
}
"""Drivers by role and name; installed packages register drivers of all roles in one group of entry points."""

MIN_WAIT_S = 0.1
"""Shortest wait between a motion and the picture of its result: three frames of a gel at 30 frames/s."""


@dataclass(frozen=True)
class Limits(TypedSettings):
    """Upper limits: workspace (mm), speeds (mm/s), force on each finger (N), age of an actuator's state (s)."""

    workspace_lower_mm: tuple[float, float, float]
    workspace_upper_mm: tuple[float, float, float]
    arm_speed_mm_s: Positive = 200.0
    force_n: Positive = 25.0
    jaw_speed_mm_s: Positive = 80.0
    state_age_s: Positive = 0.5


@dataclass(frozen=True)
class ObjectSettings(TypedSettings):
    """Position and size of every object (mm), for a rig without depth."""

    x_mm: float
    y_mm: float
    height_mm: Positive
    radius_mm: Positive

    def fit(self) -> CylinderFit:
        """Return the fit that a depth camera would have measured."""
        return CylinderFit(**vars(self), method="given", half_mm=(self.radius_mm, self.radius_mm))


class RealRig(Rig):
    """Arm, gripper, gels and camera of the given tables, under the upper limits of [limits]."""

    def __init__(
        self,
        *,
        arm: Mapping[str, Any],
        gripper: Mapping[str, Any],
        sensors: Mapping[str, Any],
        camera: Mapping[str, Any],
        limits: Mapping[str, Any],
        attempt: Mapping[str, Any] = {},
        grasp: Mapping[str, Any] = {},
        object: Mapping[str, Any] = {},
        gel: Mapping[str, Any] = {},
        planner: Mapping[str, Any] = {},
        objects: Sequence[str] = (),
        source: str = "real rig",
        sensor: str = "gelsight",
        licence: str = "",
    ) -> None:
        """Build the devices without connecting them; raise RobotConfigError, or UnknownName for a driver."""
        maxima = build(Limits, limits, where="[limits]")
        common = {"max_state_age_s": maxima.state_age_s}
        moving = common | {"max_speed_mm_s": maxima.arm_speed_mm_s, "ask": ask_on_terminal}
        closing = common | {"max_speed_mm_s": maxima.jaw_speed_mm_s, "max_force_n": maxima.force_n}
        workspace = Region(maxima.workspace_lower_mm, maxima.workspace_upper_mm)
        gels = parse_gel_settings(gel, sensors)
        if not sensors or not sensors.keys() <= {"a", "b"}:
            raise RobotConfigError(f"a rig requires gels: [sensors.a], [sensors.b] or both; got {', '.join(sensors)}")
        self._names = typed(objects, list[str], "objects", error=RobotConfigError)
        super().__init__(
            load_driver("arm", arm, "[arm]", workspace=workspace, **moving),
            load_driver("gripper", gripper, "[gripper]", **closing),
            {name: load_driver("sensors", sensors[name], f"[sensors.{name}]", finger=name) for name in sensors},
            _camera(camera),
            info={
                "source": source,
                "sensor": sensor,
                **({"licence": licence} if licence else {}),
                "gels": [{finger: gels[finger].to_dict() for finger in gels}],
            },
            attempt=_attempt(attempt, grasp, maxima),
            object_fit=build(ObjectSettings, object, where="[object]").fit() if object else None,
            planner=load_planner(planner),
        )

    def object_ids(self, count: int) -> list[str]:
        """Return the first names that the file states, or made-up ones. Raises RobotConfigError if it states fewer."""
        if self._names and count > (known := len(self._names)):
            raise RobotConfigError(f"the rig's file names {known} objects, fewer than {count}: give --objects {known}")
        return self._names[:count] or super().object_ids(count)


def load_driver(role: str, table: Mapping[str, Any], where: str, **arguments: Any) -> Any:
    """Return the unconnected device of a role that a table of a rig's file describes; raise as `build_named`."""
    return build_named(DRIVERS[role], table, "driver", where=where, clock=time.monotonic, **arguments)


def _camera(table: Mapping[str, Any]) -> Camera:
    settings = dict(table)
    file, extrinsics = settings.pop("hand_eye", None), np.eye(4)
    if file is not None:
        extrinsics = hand_eye.load_hand_eye(Path(typed(file, str, "[camera]: hand_eye", error=RobotConfigError)))
    camera: Camera = load_driver("camera", settings, "[camera]", extrinsics=extrinsics)
    if camera.has_depth and file is None:
        raise RobotConfigError(
            "[camera]: a camera with depth requires hand_eye = FILE, the calibration of `retrieve rig calibrate`"
        )
    return camera


def _attempt(attempt: Mapping[str, Any], grasp: Mapping[str, Any], limits: Limits) -> AttemptSettings:
    """Return the attempt settings: the given values, or defaults capped by [limits]; raise RobotConfigError."""
    ceilings = dict.fromkeys(("travel_mm_s", "approach_mm_s"), limits.arm_speed_mm_s)
    ceilings["closing_mm_s"] = limits.jaw_speed_mm_s
    capped = {name: min(getattr(AttemptSettings, name), ceiling) for name, ceiling in ceilings.items()}
    force_n = tuple(min(force_n, limits.force_n) for force_n in GraspSettings.force_n)
    settings = parse_attempt_settings({**capped, **attempt}, {"force_n": force_n, **grasp})
    limited = [(name, getattr(settings, name), ceiling) for name, ceiling in ceilings.items()]
    for name, value, ceiling in (*limited, ("force_n", settings.grasp.force_n[1], limits.force_n)):
        if value > ceiling:
            raise RobotConfigError(f"{name} must be at most {ceiling:g}, as [limits] states, got {value:g}")
    for name in ("settle_s", "hold_s"):
        if getattr(settings, name) < MIN_WAIT_S:
            raise RobotConfigError(
                f"[attempt]: {name} must be at least {MIN_WAIT_S:g} s, so that the gel frame is newer than the motion"
            )
    return settings
