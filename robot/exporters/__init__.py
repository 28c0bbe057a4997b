"""Exporters: each writes a recording in a format that other programs read, and is loaded on first use."""

from _touch_retrieval.registry import Registry
from robot.errors import UnknownName
from robot.exporters.exporting import Exporter

EXPORTERS: Registry[Exporter] = Registry(
    "format",
    "exporters",
    {
        "imagefolder": "robot.exporters.imagefolder:export_imagefolder",
        "lerobot": "robot.exporters.lerobot:export_lerobot",
        "open-x-tactile": "robot.exporters.open_x_tactile:export_open_x_tactile",
    },
    error=UnknownName,
)
