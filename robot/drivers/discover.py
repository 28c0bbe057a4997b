"""Discovery of connected cameras, each with the lines that name it in a rig's file.

/dev/v4l/by-id contains a link for each, named by maker, model and serial number, independent of the socket; by-path
names the socket, for cameras without a name of their own. "-video-index0" gives the pictures, higher numbers only
metadata. /sys/class/video4linux/*/name is the camera's own name.
"""

from dataclasses import dataclass
from pathlib import Path

DEV, SYS = Path("/dev"), Path("/sys")
_DRIVERS = {"realsense": "realsense", "digit": "digit", "gelsight mini": "gelsight_mini", "gelsight": "gelsight"}
"""Words in a camera's name and the driver for it; the first match is used."""


@dataclass(frozen=True)
class DiscoveredCamera:
    """A connected camera: its stable name, its own name, and the lines for its table in a rig's file."""

    device: str
    label: str
    toml: str


def camera_names(dev: Path = DEV) -> list[str]:
    """Return the stable names of the cameras as paths: by-id, or by-path (the socket) for those without one."""
    by_id, by_path = (sorted((dev / "v4l" / kind).glob("*-video-index0")) for kind in ("by-id", "by-path"))
    sockets = {path.resolve(): str(path) for path in reversed(by_path)}  # newer systems name a socket twice
    for path in by_id:
        sockets.pop(path.resolve(), None)
    return [*map(str, by_id), *sorted(sockets.values())]


def find_cameras(dev: Path = DEV, sys: Path = SYS) -> list[DiscoveredCamera]:
    """Return cameras by stable name, or by number on a system without stable names.

    `dev` and `sys` are the system's device folders.
    """
    named = camera_names(dev)
    names = named or [str(dev / path.name) for path in sorted((sys / "class" / "video4linux").glob("video*"))]
    cameras = []
    for name in names:
        folder = sys / "class" / "video4linux" / Path(name).resolve().name
        if not named and _text(folder / "index") not in ("", "0"):
            continue  # several numbers belong to one camera; its `index` 0 gives the pictures
        label = _text(folder / "name") or Path(name).name
        words = f"{label} {Path(name).name}".lower().replace("_", " ")
        driver = next((driver for word, driver in _DRIVERS.items() if word in words), "uvc")
        device = "" if driver == "realsense" else f'\ndevice = "{name}"'
        cameras.append(DiscoveredCamera(name, label, f'driver = "{driver}"{device}'))
    return cameras


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace").strip()
    except OSError:
        return ""
