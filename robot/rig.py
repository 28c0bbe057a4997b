"""The rig: arm, gripper, tactile sensors and camera, connected and closed together; and the registry of rigs."""

import sys
import time
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

from _touch_retrieval.registry import Registry
from robot.devices import Arm, Camera, Clock, Device, Gripper, TactileSensor
from robot.errors import RobotConfigError, UnknownName
from robot.grasping.planner import CylinderPlanner, GraspPlanner
from robot.grasping.settings import AttemptSettings
from robot.readings import Pose
from robot.settings import build
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
        self.planner = planner or CylinderPlanner()
        self.planner.check(self)
        self._object_on_table: str | None = None

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
        """Return names for `count` objects to collect; a simulated rig returns its own objects."""
        return [f"object-{number:04}" for number in range(1, count + 1)]

    def labels(self, object_id: str) -> Mapping[str, float | bool | str]:
        """Return the labels of an object, for recording.json. Only a simulated rig has labels; others return none."""
        return {}

    def prepare(self, object_id: str, number: int) -> None:
        """Ask a person to put this object on the table for attempt `number`.

        The request appears when the object changes. With `object_fit` it appears for every attempt, because the
        attempt before may have moved the object from its given position.

        Args:
            object_id: The object.
            number: Number of the attempt.

        Raises:
            RobotConfigError: There is no terminal for the request.
        """
        if object_id != self._object_on_table or self.object_fit is not None:
            position = (
                "on the table"
                if self.object_fit is None
                else f"at x {self.object_fit.x_mm:g}, y {self.object_fit.y_mm:g} mm"
            )
            try:
                self.ask(f"Put {object_id} {position}, remove all other objects, then press Enter.")
            except EOFError as error:
                raise RobotConfigError("a person must change the objects of this rig: run it in a terminal") from error
            self._object_on_table = object_id

    def settings(self) -> dict[str, dict[str, Any]]:
        """Return the settings that each device reports, by device name; raise DeviceError if one fails."""
        return {device.name: device.settings() for device in self.devices}

    def recover(self) -> None:
        """Make every device usable again after a failure; raise DeviceError if that requires a person."""
        for device in self.devices:
            device.recover()

    def connect(self) -> None:
        """Connect all devices or none: if one fails, close the connected ones and raise its error."""
        connected: list[Device] = []
        try:
            for device in self.devices:
                device.connect()
                connected.append(device)
        except BaseException:
            _close_all(connected)
            raise

    def close(self) -> None:
        """Close every device, the last one first, then raise the first failure; a second call does nothing."""
        if failure := _close_all(self.devices):
            raise failure

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        failure = _close_all(self.devices)
        if failure and error is None:
            raise failure
        if failure and error is not None:
            error.add_note(f"and while the rig was closed: {failure}")


def _close_all(devices: tuple[Device, ...] | list[Device]) -> BaseException | None:
    """Close all devices from the last to the first and return the first failure."""
    failure: BaseException | None = None
    for device in reversed(devices):
        try:
            device.close()
        except BaseException as error:  # a second Ctrl-C must not leave the rest open
            failure = failure or error
    return failure


def load_rig(spec: str, *, seed: int, **settings: Any) -> Rig:
    """Build the rig that `spec` names, but do not connect it; `spec` is a name of RIGS or a TOML file.

        rig = "sim"
        fingers = ["a", "b"]   # the other keys are settings of that rig

    The rig's `info` contains its name and settings, so that it can be built again.

    Args:
        spec: Name or file.
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
    name = spec
    if spec.endswith(".toml"):
        name, settings = _read_toml(Path(spec), settings)
    rig = build(RIGS.resolve(name), settings, where=spec if spec.endswith(".toml") else "", seed=seed)
    rig.info |= {"rig": name, "rig_settings": settings}
    return rig


def _read_toml(path: Path, over: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the name of the rig and its settings."""
    try:
        document = tomllib.loads(read_content(path, RobotConfigError).decode())
    except ValueError as error:
        raise RobotConfigError(f"{path} is not TOML: {error}") from error
    name = document.pop("rig", None)
    if not isinstance(name, str):
        raise RobotConfigError(f'{path} must name its rig, as in rig = "sim"; got {name!r}')
    return name, {**document, **over}
