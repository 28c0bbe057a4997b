"""The parts of LeRobot that a camera needs, after its documentation, for tests without LeRobot."""

import dataclasses
import sys
from importlib.util import find_spec
from types import ModuleType

NAMES = ("lerobot", "lerobot.cameras", "lerobot.utils", "lerobot.utils.errors")


@dataclasses.dataclass(kw_only=True)
class CameraConfig:
    """Its subclasses are found by the name with which they are registered."""

    fps: int | None = None
    width: int | None = None
    height: int | None = None

    choices = {}  # noqa: RUF012

    @classmethod
    def register_subclass(cls, name):
        return lambda subclass: cls.choices.setdefault(name, subclass)

    @classmethod
    def get_known_choices(cls):
        return cls.choices


class Camera:
    """Connects in a `with` block."""

    def __init__(self, config):
        self.fps, self.width, self.height = config.fps, config.width, config.height

    def __enter__(self):
        self.connect()
        return self

    def __exit__(self, *_):
        self.disconnect()


def provide_lerobot(monkeypatch):
    """Make `lerobot` importable: the installed one, or the stub."""
    if find_spec("lerobot") is None:
        modules = {name: ModuleType(name) for name in NAMES}
        modules["lerobot.cameras"].Camera, modules["lerobot.cameras"].CameraConfig = Camera, CameraConfig
        for name in ("DeviceAlreadyConnectedError", "DeviceNotConnectedError"):
            setattr(modules["lerobot.utils.errors"], name, type(name, (ConnectionError,), {}))
        for name, module in modules.items():
            monkeypatch.setitem(sys.modules, name, module)
