"""Whole words of a name tell the gel cameras, a stated depth camera takes no photo, and the choice is printed."""

import json

import pytest

from robot.errors import ImporterError
from robot.importers.lerobot import import_lerobot
from tests.miniatures import lerobot


def check(folder, get):
    source = folder / "source"
    lerobot.write(source)
    path = source / "meta/info.json"
    info = json.loads(path.read_text())
    for name in ("observation.images.digital_zoom", "observation.images.angel", "observation.images.touchscreen"):
        info["features"][name] = dict(info["features"][lerobot.WRIST])
    depth = dict(info["features"][lerobot.WRIST], info={"video.is_depth_map": True})
    info["features"] = {"observation.images.a_depth": depth, **info["features"]}
    path.write_text(json.dumps(info))
    recording = import_lerobot(source, folder / "out")
    assert recording.info["fingers"] == 2
    choice = f"gel cameras: {lerobot.LEFT}, {lerobot.RIGHT}; photo: {lerobot.WRIST}"
    assert any(choice in note for note in recording.notes)

    for name in (lerobot.LEFT, lerobot.RIGHT):
        info["features"].pop(name)
    path.write_text(json.dumps(info))
    with pytest.raises(ImporterError, match="choose them with --option"):
        import_lerobot(source, folder / "none")
