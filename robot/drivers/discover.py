"""Discovery of connected devices, each with the lines that name it in a rig's file.

Cameras: /dev/v4l/by-id contains a link for each, named by maker, model and serial number, independent of the socket;
"-video-index0" gives the pictures, higher numbers only metadata. /sys/class/video4linux/*/name is the camera's own
name. Serial ports: /dev/serial/by-id, and the ports that pyserial lists. RealSense and Kinect 2 cameras are listed
by their packages if these are installed.
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
"""Words in a camera's name and the driver for it; the first match is used."""
SHARED_NAME_NOTE = (
    "a camera has no name of its own in by-id: identical cameras may share a name, which may lead to the other camera "
    "after a restart; name these cameras by their sockets, in by-path"
)


@dataclass(frozen=True)
class DiscoveredDevice:
    """A connected device.

    Attributes:
        kind: "camera", "serial port", "realsense" or "kinect2".
        device: Stable name.
        label: The device's own name.
        toml: Lines for the device's table in a rig's file.
    """

    kind: str
    device: str
    label: str
    toml: str


@dataclass(frozen=True)
class UsbPort:
    """The USB socket of a camera.

    Attributes:
        bus: Number of the bus; the devices of a bus share its speed.
        port: Numbers of the ports from the bus to the device, such as "2.3" for port 3 of a hub at port 2.
        mbit_s: Speed at which the device is connected: 480 for USB 2, 5000 and more for USB 3.
    """

    bus: int
    port: str
    mbit_s: int

    def __str__(self) -> str:
        return f"bus {self.bus}, port {self.port}, {self.mbit_s} Mbit/s"


def usb_port(device: str, sys: Path = SYS) -> UsbPort | None:
    """Return the USB socket of a camera, from the path of its device; None if it is unknown."""
    interface = (sys / "class" / "video4linux" / Path(device).resolve().name / "device").resolve()
    words = [_text(interface.parent / name) for name in ("busnum", "devpath", "speed")]
    bus, port, mbit_s = words
    return UsbPort(int(bus), port, int(mbit_s)) if bus.isdigit() and port and mbit_s.isdigit() else None


def discover(dev: Path = DEV, sys: Path = SYS) -> list[DiscoveredDevice]:
    """Return all connected devices, cameras first; `dev` and `sys` are the system's device folders."""
    return [*find_cameras(dev, sys), *find_serial_ports(dev), *find_realsenses(), *find_kinects()]


def camera_names(dev: Path = DEV) -> list[str]:
    """Return the stable names of the cameras as paths: by-id, or by-path (the socket) for those without one."""
    found = {path.resolve(): str(path) for path in reversed(_pictures(dev / "v4l" / "by-path"))}
    by_id = _pictures(dev / "v4l" / "by-id")
    for path in by_id:
        found.pop(path.resolve(), None)
    return [*map(str, by_id), *sorted(found.values())]


def shared_name_note(names: Iterable[str]) -> str:
    """Return a note if some cameras have a name only in by-path, else ""."""
    kinds = {Path(name).parent.name for name in names}
    return SHARED_NAME_NOTE if kinds >= {"by-id", "by-path"} else ""


def _pictures(folder: Path) -> list[Path]:
    return [path for path in _entries(folder) if path.name.endswith("-video-index0")]


def find_cameras(dev: Path = DEV, sys: Path = SYS) -> list[DiscoveredDevice]:
    """Return cameras by stable name, or by number on a system without stable names."""
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
    """Return serial ports by stable name, then the other ports of pyserial; any of them may be the gripper."""
    stable = _entries(dev / "serial" / "by-id")
    found = [_port(str(path), path.name) for path in stable]
    known = {path.resolve() for path in stable}
    return found + [_port(device, label) for device, label in _listed_ports() if Path(device).resolve() not in known]


def _port(device: str, label: str) -> DiscoveredDevice:
    return DiscoveredDevice("serial port", device, label, f'driver = "wsg50"\nport = "{device}"')


def _listed_ports() -> list[tuple[str, str]]:
    """Return the ports with hardware; a ttyS0 without hardware is left out."""
    try:
        from serial.tools import list_ports
    except ImportError:
        return []
    return [(port.device, port.description) for port in list_ports.comports() if port.hwid != "n/a"]


def find_realsenses() -> list[DiscoveredDevice]:
    """Return RealSense cameras if pyrealsense2 is installed."""

    def list_cameras(rs: Any) -> list[DiscoveredDevice]:
        known = rs.camera_info
        return [
            _by_serial("realsense", each.get_info(known.serial_number), each.get_info(known.name))
            for each in rs.context().query_devices()
        ]

    return _list_with_package("RealSense", "pyrealsense2", list_cameras)


def find_kinects() -> list[DiscoveredDevice]:
    """Return Kinect 2 cameras if pylibfreenect2 is installed."""

    def list_cameras(package: Any) -> list[DiscoveredDevice]:
        freenect = package.Freenect2()
        serials = map(freenect.getDeviceSerialNumber, range(freenect.enumerateDevices()))
        return [_by_serial("kinect2", decode_serial(serial), "Kinect 2") for serial in serials]

    return _list_with_package("Kinect 2", "pylibfreenect2", list_cameras)


def _list_with_package(
    camera: str, package: str, list_cameras: Callable[[Any], list[DiscoveredDevice]]
) -> list[DiscoveredDevice]:
    """List cameras with the vendor's package; return [] if it is not installed, and log a warning if it fails."""
    try:
        return list_cameras(import_module(package))
    except ImportError as error:
        if need := missing_library(package, error):
            log.warning("%s cameras could not be listed: this requires %s", camera, need)
    except Exception as error:  # a failing vendor package must not hide the other devices
        log.warning("%s cameras could not be listed: %s", camera, error)
    return []


def decode_serial(serial: str | bytes) -> str:
    """Return a serial number as text; pylibfreenect2 returns bytes or text, depending on its version."""
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
