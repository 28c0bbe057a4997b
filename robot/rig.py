"""A rig: arm, gripper, tactile sensors and camera that connect all or nothing and always close; and rigs by name."""

import inspect
import time
import tomllib
import typing
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Self

from robot.devices import Arm, Camera, Clock, Device, Gripper, TactileSensor
from robot.errors import RobotConfigError, UnknownName

RIGS = {"sim": "robot.sim.rig:SimRig"}
"""Rigs by name, imported when asked for. A new rig is a file with a subclass of Rig, and a row here."""


class Rig:
    """The devices of one rig, and what a recording says of it.

    `info` goes into recording.json: source and sensor at least. `clock` and `sleep` keep the rig's time, in which
    frames are stamped; a simulated rig gives its own. `ask` shows a person a sentence and returns when it is done.
    """

    can_run_jobs: ClassVar[bool] = False
    """Whether several of this rig can exist at once, each in its own process."""

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
        ask: Callable[[str], object] = input,
    ) -> None:
        self.arm, self.gripper, self.camera = arm, gripper, camera
        self.sensors = dict(sorted(sensors.items()))
        self.info = dict(info)
        self.clock, self.sleep, self.ask = clock, sleep, ask
        self._on_table: str | None = None

    @classmethod
    def from_settings(cls, seed: int, settings: Mapping[str, Any]) -> Self:
        """Build from plain settings: the keywords of the class, `seed` among them or not, of the types it annotates.

        Raises RobotConfigError.
        """
        parameters = inspect.signature(cls).parameters
        known = sorted(set(parameters) - {"seed"})
        if unknown := sorted(set(settings) - set(known)):
            raise RobotConfigError(f"{cls.__name__} has no setting {unknown[0]!r}; it knows {', '.join(known)}")
        hints = typing.get_type_hints(cls.__init__)
        for name, value in settings.items():
            _check_type(name, hints.get(name), value)
        arguments: dict[str, Any] = {**settings, "seed": seed} if "seed" in parameters else dict(settings)
        return cls(**arguments)

    @property
    def devices(self) -> tuple[Device, ...]:
        """All devices in the order in which they are connected."""
        return self.arm, self.gripper, *self.sensors.values(), self.camera

    def object_ids(self, count: int) -> list[str]:
        """Names for `count` objects to collect; a simulated rig says which objects it has."""
        return [f"object-{number:04}" for number in range(1, count + 1)]

    def prepare(self, object_id: str, number: int) -> None:
        """Have this object on the table for attempt `number`: asks a person when the object changes.

        Raises RobotConfigError where nobody can answer.
        """
        if object_id != self._on_table:
            try:
                self.ask(f"Put {object_id} on the table, alone, and press Enter.")
            except EOFError as error:
                raise RobotConfigError("a person must change the objects of this rig: run it in a terminal") from error
            self._on_table = object_id

    def settings(self) -> dict[str, dict[str, Any]]:
        """What each device reports of its settings, by its name. Raises DeviceError."""
        return {device.name: device.settings() for device in self.devices}

    def connect(self) -> None:
        """Connect all devices or none: where one fails, those before it are closed again and its error is raised."""
        connected: list[Device] = []
        try:
            for device in self.devices:
                device.connect()
                connected.append(device)
        except BaseException:
            _close_all(connected)
            raise

    def close(self) -> None:
        """Close every device, the last one first, whatever fails, then raise the first failure; twice does nothing."""
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
    """Close from the last to the first; returns the first failure."""
    failure: BaseException | None = None
    for device in reversed(devices):
        try:
            device.close()
        except BaseException as error:  # a second Ctrl-C must not leave the rest open
            failure = failure or error
    return failure


def load_rig(spec: str, *, seed: int, **settings: Any) -> Rig:
    """Build, without connecting it, the rig that `spec` names: a name of RIGS, or a TOML file.

        rig = "sim"

        [sim]                  # settings of that rig; `settings` given here override them
        fingers = ["a", "b"]

    The recording's `info` says name and settings, so that the rig can be built again. Raises UnknownName, which
    lists the known ones, and RobotConfigError.
    """
    name = spec
    if spec.endswith(".toml"):
        name, settings = _read_toml(Path(spec), settings)
    if name not in RIGS:
        raise UnknownName(f"no rig is called {name!r}; known: {', '.join(sorted(RIGS))}, or give a .toml file")
    module, class_name = RIGS[name].split(":")
    rig_class: type[Rig] = getattr(import_module(module), class_name)
    rig = rig_class.from_settings(seed, settings)
    rig.info |= {"rig": name, "rig_settings": settings}
    return rig


_PLAIN: Mapping[Any, tuple[type | tuple[type, ...], str]] = {
    bool: (bool, "true or false"),
    int: (int, "a whole number"),
    float: ((int, float), "a number"),
    str: (str, "a text in quotes"),
}


def _check_type(name: str, hint: Any, value: object) -> None:
    """Raise RobotConfigError for a plain value, or list of such, that is not of the annotated type; others pass."""
    if typing.get_origin(hint) is Sequence:
        kind = typing.get_args(hint)[0]
        good = isinstance(value, list | tuple) and all(_is_plain(each, kind) for each in value)
        words = f"a list, each of them {_PLAIN[kind][1]}" if kind in _PLAIN else "a list"
    else:
        good, words = _is_plain(value, hint), _PLAIN[hint][1] if hint in _PLAIN else ""
    if not good:
        raise RobotConfigError(f"{name} must be {words}, got {value!r}")


def _is_plain(value: object, hint: Any) -> bool:
    """Python counts true and false among the whole numbers; a file of settings does not."""
    return hint not in _PLAIN or (isinstance(value, _PLAIN[hint][0]) and (hint is bool or not isinstance(value, bool)))


def check_seed(seed: int) -> None:
    """Raise RobotConfigError unless random numbers can be drawn from `seed`."""
    if not isinstance(seed, int) or seed < 0:
        raise RobotConfigError(f"seed must be a whole number from 0, got {seed!r}")


def _read_toml(path: Path, over: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Name of the rig and its settings."""
    try:
        document = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise RobotConfigError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise RobotConfigError(f"{path} is not TOML: {error}") from error
    name = document.pop("rig", None)
    if not isinstance(name, str):
        raise RobotConfigError(f'{path} must say which rig it is for, as in rig = "sim"; got {name!r}')
    settings = document.pop(name, {})
    if document:
        raise RobotConfigError(f"{path}: unknown key {sorted(document)[0]!r}; known: rig, and the table [{name}]")
    if not isinstance(settings, dict):
        raise RobotConfigError(f"{path}: {name} must be a table, got {settings!r}")
    return name, {**settings, **over}
