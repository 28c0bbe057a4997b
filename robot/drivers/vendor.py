"""What drivers over a maker's package share: loading it, its exceptions, its numbers, and starting again."""

import contextlib
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from robot.devices import Camera
from robot.drivers.video.frames import MAX_CAMERA_WAIT_S
from robot.errors import DeviceError
from robot.settings import TypedSettings, bounded

_LIBRARY = re.compile(r"(lib[^\s:/]+\.(?:so|dylib)[.\d]*)")
"""As the loaders of Linux and macOS name what they do not find."""

_INSTALL_COMMANDS = {
    "libfreenect2": "ldconfig after building libfreenect2 with shared libraries (github.com/OpenKinect/libfreenect2)",
    "libusb": "apt-get install libusb-1.0-0 (Debian, Ubuntu) or brew install libusb (macOS)",
    "libudev": "apt-get install libudev1 (Debian, Ubuntu)",
}


def import_package(package: str, device: str, install: str) -> Any:
    """The maker's package, imported. Raises DeviceError that says what is missing: it, or a library of the system."""
    try:
        return import_module(package)
    except ImportError as error:
        need = missing_library(package, error) or f"{package}, which is missing; {install}"
        raise DeviceError(f"{device} needs {need}") from error


def missing_library(package: str, error: ImportError) -> str | None:
    """In words, where the package is there and a library of the system that it needs is not; else None."""
    found = None if isinstance(error, ModuleNotFoundError) else _LIBRARY.search(str(error))
    if found is None:
        return None
    library = found[1]
    run = next((run for name, run in _INSTALL_COMMANDS.items() if library.startswith(name)), None)
    cure = f"run {run}" if run else "install the package of your system that brings it"
    return f"{library}, a library of the system that {package} cannot find; {cure}"


@dataclass(frozen=True, kw_only=True)
class VendorSettings(TypedSettings):
    """serial: which camera, where several are connected. warmup_frames: dropped at first. timeout_s: of a picture."""

    serial: str = ""
    warmup_frames: int = bounded(0, 1000, 5)
    timeout_s: float = bounded(1e-3, MAX_CAMERA_WAIT_S, 3.0, unit="s")


def check_finite(what: str, numbers: Iterable[float]) -> list[float]:
    """What a camera says of itself. Raises DeviceError for NaN or infinity."""
    found = [float(each) for each in numbers]
    if not all(map(math.isfinite, found)):
        raise DeviceError(f"{what} must be finite numbers, got {found}; plug the camera in again")
    return found


@contextlib.contextmanager
def vendor_errors(failure: str) -> Iterator[None]:
    """A DeviceError that begins with `failure` for whatever a maker's package raises; OSError and ours pass."""
    try:
        yield
    except (DeviceError, OSError):
        raise
    except Exception as error:
        raise DeviceError(f"{failure}: {error or type(error).__name__}") from error


class VendorCamera(Camera):
    """A camera behind its maker's package. `_reported`: what it says of its settings."""

    _reported: Mapping[str, Any] = {}

    def _settings(self) -> dict[str, Any]:
        return dict(self._reported)

    def _recover(self) -> None:
        """Close whatever can be closed, then connect whole or not at all."""
        with contextlib.suppress(DeviceError, OSError):
            self._close()
        try:
            self._connect()
        except BaseException:
            with contextlib.suppress(DeviceError, OSError):
                self._close()
            raise

    def _choose_camera(self, requested: str, connected: Sequence[str]) -> int:
        """Return the place of the camera to open among the serial numbers of those connected. Raises DeviceError."""
        if requested in connected or (not requested and len(connected) == 1):
            return connected.index(requested) if requested else 0
        known = ", ".join(connected) or "none"
        if requested:
            raise DeviceError(f"{self.name} {requested} must be connected; connected: {known}")
        raise DeviceError(f"one {self.name} must be connected, or its serial number given; connected: {known}")
