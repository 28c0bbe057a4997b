"""The rig: arm, gripper, tactile sensors and camera, connected and closed together; and the planner of its grasps.

A rig's file names the rig and the planner; the other keys of a planner's table are keyword arguments of its class:

    rig = "sim"
    fingers = ["a", "b"]   # the other keys are settings of that rig
    [planner]
    name = "cylinder"
    search_margin_mm = 100
"""

import contextlib
import sys
import time
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from _touch_retrieval.registry import Registry
from _touch_retrieval.text import decode_text
from robot.devices import Arm, Camera, Clock, Device, Gripper, TactileSensor
from robot.errors import RobotConfigError, UnknownName
from robot.grasping.settings import AttemptSettings, GraspSettings
from robot.readings import RGBD, Pose
from robot.settings import build, build_named
from robot.sight.cylinder import CylinderFit
from robot.storage import read_content

RIGS: "Registry[type[Rig]]" = Registry(
    "a rig that is not a .toml file",
    "rigs",
    {"real": "robot.real_rig:RealRig", "sim": "robot.sim.rig:SimRig"},
    error=UnknownName,
    base="robot.rig:Rig",
)
"""Rigs by name, imported on first use."""

PLANNERS: "Registry[type[GraspPlanner]]" = Registry(
    "[planner]: name",
    "planners",
    {"cylinder": "robot.grasping.planner:CylinderPlanner", "mesh": "robot.sim.mesh_planner:MeshPlanner"},
    error=UnknownName,
    base="robot.rig:GraspPlanner",
)
"""Grasp planners by name, imported on first use."""


@dataclass(frozen=True)
class GraspPlan:
    """One planned grasp.

    Attributes:
        pose: Pose in which the jaws close.
        above: Pose after the lift.
        opening_mm: Opening before the grasp.
        force_n: Force on each finger.
        approach: Poses on the way to `pose`, the last one clear of the object; `above` if empty.
        fit: Description of the object, for the attempt log.

    >>> pose, above = robot.Pose(0.0, 0.0, 60.0, yaw_rad=1.0), robot.Pose(0.0, 0.0, 240.0, yaw_rad=1.0)
    >>> robot.GraspPlan(pose, above, opening_mm=110.0, force_n=10.0).approach
    ()
    """

    pose: Pose
    above: Pose
    opening_mm: float
    force_n: float
    approach: tuple[Pose, ...] = ()
    fit: Mapping[str, Any] = field(default_factory=dict)


class GraspPlanner(ABC):
    """Plans one grasp from one picture.

    Attributes:
        needs_depth: Whether the picture must have depth; if not, depth is read only to be recorded.

    >>> class OnTheMark(robot.GraspPlanner):
    ...     needs_depth = False
    ...
    ...     def plan(self, rig, image, settings, rng):
    ...         yaw_rad = rng.uniform(0.0, 3.14)
    ...         pose, above = (robot.Pose(0.0, 0.0, z_mm, yaw_rad) for z_mm in (60.0, 240.0))
    ...         return robot.GraspPlan(pose, above, opening_mm=rig.gripper.stroke_mm, force_n=10.0)
    """

    needs_depth: bool = True

    def check(self, rig: "Rig") -> None:
        """Raise RobotConfigError if this planner cannot plan for `rig`."""
        if self.needs_depth and rig.object_fit is None and not rig.camera.has_depth:
            raise RobotConfigError(
                f"{rig.camera.name} has no depth: give the position and size of every object in [object]"
            )

    @abstractmethod
    def plan(self, rig: "Rig", image: RGBD, settings: GraspSettings, rng: np.random.Generator) -> GraspPlan:
        """Draw one grasp of the object in `image`, taken by the camera of the connected rig.

        `rng` is the source of all random choices.

        Raises:
            UngraspableError: No attempt at this object can succeed.
            PlanError: This attempt is impossible.
        """


def load_planner(table: Mapping[str, Any], default: str = "cylinder") -> GraspPlanner:
    """Return the planner that the table [planner] of a rig's file names; raise as `build_named`."""
    return build_named(PLANNERS, table, "name", where="[planner]", default=default)


def ask_on_terminal(sentence: str) -> None:
    """Print a request to the user on stderr and wait for Enter; raise EOFError if there is no terminal."""
    print(sentence, end=" ", file=sys.stderr, flush=True)
    input()


class Rig:
    """The devices of one rig and its description for recordings.

    Args:
        arm: Moves the gripper.
        gripper: Closes the jaws.
        sensors: Tactile sensors by finger, "a" or "b".
        camera: Photographs the table.
        info: Entries of recording.json; at least source and sensor.
        clock: Returns the time in s, on the same clock as the frames' time stamps; a simulated rig has its own.
        sleep: Waits for a time in s of this clock.
        ask: Shows a request to a person and returns when it is done.
        attempt: Default attempt settings of this rig.
        object_fit: Position and size of every object, for a rig whose camera cannot measure them.
        planner: Chooses the grasps; a CylinderPlanner by default.

    >>> with robot.load_rig("sim", seed=0) as rig:
    ...     sorted(rig.sensors), rig.arm.is_connected
    (['a', 'b'], True)
    >>> rig.arm.is_connected
    False
    """

    can_run_jobs: ClassVar[bool] = False
    """Whether several instances of this rig can exist at once, each in its own process."""

    def __init__(
        self,
        arm: Arm,
        gripper: Gripper,
        sensors: Mapping[str, TactileSensor],
        camera: Camera,
        *,
        info: Mapping[str, Any],
        clock: Clock = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        ask: Callable[[str], object] = ask_on_terminal,
        attempt: AttemptSettings | None = None,
        object_fit: CylinderFit | None = None,
        planner: GraspPlanner | None = None,
    ) -> None:
        self.arm, self.gripper, self.camera = arm, gripper, camera
        self.sensors = dict(sorted(sensors.items()))
        self.info = dict(info)
        self.clock, self.sleep, self.ask = clock, sleep, ask
        self.attempt, self.object_fit = attempt or AttemptSettings(), object_fit
        self.planner = planner or load_planner({})
        self.planner.check(self)
        self.session: str | None = None
        self._object_on_table: str | None = None
        self._connected = contextlib.ExitStack()

    def begin_session(self, session: str, first_attempts: Mapping[str, int], stride: int) -> None:
        """Begin a session: a real rig drifts by itself, a simulated one by these values.

        Args:
            session: Name of the session.
            first_attempts: Number of attempts in the session before the first one at each object, about.
            stride: Number of attempts from one at an object to its next, about.
        """
        self.session = session

    @property
    def devices(self) -> tuple[Device, ...]:
        """All devices in the order of connection."""
        return self.arm, self.gripper, *self.sensors.values(), self.camera

    @property
    def home(self) -> Pose:
        """Pose at the top of the workspace's far side (+y); a camera at -y should not see the hand there."""
        lower, upper = self.arm.workspace.lower, self.arm.workspace.upper
        return Pose((lower[0] + upper[0]) / 2, upper[1], upper[2], 0.0)

    def object_ids(self, count: int) -> list[str]:
        """Return names for `count` objects to collect."""
        return [f"object-{number:04}" for number in range(1, count + 1)]

    def labels(self, object_id: str) -> Mapping[str, float | bool | str]:
        """Return the labels of an object, for recording.json; only a simulated rig has any."""
        return {}

    def prepare(self, object_id: str, number: int) -> None:
        """Ask a person to put this object on the table for attempt `number`; raise RobotConfigError without a terminal.

        The request appears when the object changes; with `object_fit` for every attempt, because the attempt before
        may have moved the object from its given position.
        """
        fit = self.object_fit
        if object_id == self._object_on_table and fit is None:
            return
        position = "on the table" if fit is None else f"at x {fit.x_mm:g}, y {fit.y_mm:g} mm"
        try:
            self.ask(f"Put {object_id} {position}, remove all other objects, then press Enter.")
        except EOFError as error:
            raise RobotConfigError("a person must change the objects of this rig: run it in a terminal") from error
        self._object_on_table = object_id

    def settings(self) -> dict[str, dict[str, Any]]:
        """Return the settings that each device reports, by device name."""
        return {device.name: device.settings() for device in self.devices}

    def recover(self) -> None:
        """Make every device usable again after a failure; raise DeviceError if that requires a person."""
        for device in self.devices:
            device.recover()

    def connect(self) -> None:
        """Connect all devices or none: if one fails, close the connected ones and raise its error."""
        with contextlib.ExitStack() as connected:
            for device in self.devices:
                connected.enter_context(device)
            self._connected = connected.pop_all()

    def close(self) -> None:
        """Close every device, the last one first, even if one fails; a second call does nothing."""
        self._connected.close()

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        try:
            self.close()
        except BaseException as failure:
            if error is None:
                raise
            error.add_note(f"and while the rig was closed: {failure}")


def load_rig(spec: str, *, seed: int, **settings: Any) -> Rig:
    """Build the rig that `spec` names, but do not connect it.

    Args:
        spec: Name of RIGS, or a TOML file.
        seed: Seed of the rig's random choices.
        settings: Settings of the rig; they override those of the file.

    Raises:
        UnknownName: No rig has this name; the message lists the known ones.
        RobotConfigError: The file cannot be read, or a setting is invalid.

    >>> robot.load_rig("sim", seed=0, fingers=["a"]).sensors.keys()
    dict_keys(['a'])
    >>> robot.load_rig("juggler", seed=0)
    Traceback (most recent call last):
    robot.errors.UnknownName: a rig that is not a .toml file must be one of real, sim; got 'juggler'. ...
    """
    name, where = spec, ""
    if spec.endswith(".toml"):
        try:
            document = tomllib.loads(decode_text(read_content(spec, RobotConfigError)))
        except ValueError as error:
            raise RobotConfigError(f"{spec} is not TOML: {error}") from error
        name, where, settings = document.pop("rig", None), spec, {**document, **settings}
        if not isinstance(name, str):
            raise RobotConfigError(f'{spec} must name its rig, as in rig = "sim"; got {name!r}')
    rig = build(RIGS.resolve(name), settings, where=where, seed=seed)
    rig.info |= {"rig": name, "rig_settings": settings}
    return rig
