"""What is connected to this computer, found with what is installed, each with the lines that name it in a rig's file.

Cameras: /dev/v4l/by-id holds a link for each, named by maker, model and serial number, which stays the same wherever it
is plugged in; "-video-index0" gives the pictures, higher numbers only data about them. /sys/class/video4linux/*/name is
what a camera calls itself. Serial ports: /dev/serial/by-id, and what pyserial lists. RealSense and Kinect 2 are asked
through their packages where these are installed.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from robot.drivers.vendor import missing_library

log = logging.getLogger(__name__)
DEV, SYS = Path("/dev"), Path("/sys")
_GEL_SENSORS = {"digit": "digit", "gelsight mini": "gelsight_mini", "gelsight": "gelsight"}
"""Words in a camera's name, and the driver for it; the first that fits."""
SHARED_NAME_NOTE = (
    "a camera here has no name of its own in by-id: where equal cameras share one, it may lead to the other camera "
    "tomorrow; name those by their sockets, in by-path"
)


@dataclass(frozen=True)
class DiscoveredDevice:
    """kind: camera, serial port, realsense or kinect2. device: its stable name. label: what it calls itself.
    toml: lines for the rig's file, under the table of that device.
    """

    kind: str
    device: str
    label: str
    toml: str


def discover(dev: Path = DEV, sys: Path = SYS) -> list[DiscoveredDevice]:
    """Everything found, cameras first. `dev`, `sys`: where the system keeps its devices."""
    return [*find_cameras(dev, sys), *find_serial_ports(dev), *find_realsenses(), *find_kinects()]


def camera_names(dev: Path = DEV) -> list[str]:
    """Stable names of the cameras, as paths: by-id, and by-path (which socket) for those without one."""
    found = {path.resolve(): str(path) for path in reversed(_pictures(dev / "v4l" / "by-path"))}
    by_id = _pictures(dev / "v4l" / "by-id")
    for path in by_id:
        found.pop(path.resolve(), None)
    return [*map(str, by_id), *sorted(found.values())]


def shared_name_note(names: Iterable[str]) -> str:
    """What must be known of such names, or nothing."""
    kinds = {Path(name).parent.name for name in names}
    return SHARED_NAME_NOTE if kinds >= {"by-id", "by-path"} else ""


def _pictures(folder: Path) -> list[Path]:
    return [path for path in _entries(folder) if path.name.endswith("-video-index0")]


def find_cameras(dev: Path = DEV, sys: Path = SYS) -> list[DiscoveredDevice]:
    """Cameras by stable name; by number where the system makes no stable names."""
    found, names = [], camera_names(dev)
    note = f"# {shared_name_note(names)}\n" if shared_name_note(names) else ""
    for name in names:
        label = _label(sys, Path(name).resolve().name) or Path(name).name
        found.append(DiscoveredDevice("camera", name, label, note + _camera_toml(name, f"{label} {Path(name).name}")))
    return found or _numbered_cameras(dev, sys)


def _numbered_cameras(dev: Path, sys: Path) -> list[DiscoveredDevice]:
    found = []
    for entry in _entries(sys / "class" / "video4linux"):
        # Several numbers belong to one camera; its `index` 0 gives the pictures.
        if entry.name.startswith("video") and (_text(entry / "index") or "0") == "0":
            device, label = str(dev / entry.name), _label(sys, entry.name)
            found.append(
                DiscoveredDevice("camera", device, label, _camera_toml(device, label) + "\nallow_index = true")
            )
    return found


def _label(sys: Path, name: str) -> str:
    return _text(sys / "class" / "video4linux" / name / "name")


def _camera_toml(device: str, words: str) -> str:
    plain = words.lower().replace("_", " ")
    driver = next((driver for word, driver in _GEL_SENSORS.items() if word in plain), "uvc")
    return f'driver = "{driver}"\ndevice = "{device}"'


def find_serial_ports(dev: Path = DEV) -> list[DiscoveredDevice]:
    """Serial ports by stable name, then those that only pyserial knows. Which of them is the gripper, nobody says."""
    stable = _entries(dev / "serial" / "by-id")
    found = [_port(str(path), path.name) for path in stable]
    known = {path.resolve() for path in stable}
    return found + [_port(device, label) for device, label in _listed_ports() if Path(device).resolve() not in known]


def _port(device: str, label: str) -> DiscoveredDevice:
    return DiscoveredDevice("serial port", device, label, f'driver = "wsg50"\nport = "{device}"')


def _listed_ports() -> list[tuple[str, str]]:
    """USB and built-in ports that answer to something; a bare ttyS0 without hardware behind it is left out."""
    try:
        from serial.tools import list_ports
    except ImportError:
        return []
    return [(port.device, port.description) for port in list_ports.comports() if port.hwid != "n/a"]


def find_realsenses() -> list[DiscoveredDevice]:
    """RealSense cameras, where pyrealsense2 is installed."""

    def list_cameras(rs: Any) -> list[DiscoveredDevice]:
        known = rs.camera_info
        return [
            _by_serial("realsense", each.get_info(known.serial_number), each.get_info(known.name))
            for each in rs.context().query_devices()
        ]

    return _list_with_package("RealSense", "pyrealsense2", list_cameras)


def find_kinects() -> list[DiscoveredDevice]:
    """Kinect 2 cameras, where pylibfreenect2 is installed."""

    def list_cameras(package: Any) -> list[DiscoveredDevice]:
        freenect = package.Freenect2()
        serials = map(freenect.getDeviceSerialNumber, range(freenect.enumerateDevices()))
        return [_by_serial("kinect2", decode_serial(serial), "Kinect 2") for serial in serials]

    return _list_with_package("Kinect 2", "pylibfreenect2", list_cameras)


def _list_with_package(
    camera: str, package: str, list_cameras: Callable[[Any], list[DiscoveredDevice]]
) -> list[DiscoveredDevice]:
    """List cameras through their maker's package; nothing where it is not installed, and a warning where it fails."""
    try:
        return list_cameras(import_module(package))
    except ImportError as error:
        if need := missing_library(package, error):
            log.warning("%s cameras could not be listed: that needs %s", camera, need)
    except Exception as error:  # a maker's package that fails must not hide the other devices
        log.warning("%s cameras could not be listed: %s", camera, error)
    return []


def decode_serial(serial: str | bytes) -> str:
    """pylibfreenect2 gives serial numbers as bytes or text, by its version."""
    return serial.decode("ascii", "replace") if isinstance(serial, bytes) else serial


def _by_serial(driver: str, serial: str, label: str) -> DiscoveredDevice:
    return DiscoveredDevice(driver, serial, label, f'driver = "{driver}"\nserial = "{serial}"')


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace").strip()
    except OSError:
        return ""
