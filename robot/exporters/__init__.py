"""Exporters: each writes a recording in a format that other programs read, and is loaded when it is asked for."""

from importlib import import_module
from typing import cast

from robot.errors import UnknownName
from robot.exporters.base import Exporter

EXPORTERS = {
    "imagefolder": "robot.exporters.imagefolder:export_imagefolder",
    "lerobot": "robot.exporters.lerobot:export_lerobot",
    "open-x-tactile": "robot.exporters.open_x_tactile:export_open_x_tactile",
}


def load_exporter(name: str) -> Exporter:
    """Return the exporter to the format called `name`. Raises UnknownName, which lists the known ones.

    >>> from robot.exporters import load_exporter
    >>> load_exporter("lerobot").__name__
    'export_lerobot'
    """
    if name not in EXPORTERS:
        raise UnknownName(f"no format is called {name!r}; known: {', '.join(sorted(EXPORTERS))}")
    module, function = EXPORTERS[name].split(":")
    return cast(Exporter, getattr(import_module(module), function))
