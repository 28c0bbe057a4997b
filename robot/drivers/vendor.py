"""Common parts of drivers over a vendor's package: import, exceptions, checks of numbers, and recovery."""

import contextlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from robot.devices import Camera
from robot.drivers.usb_camera.stream import MAX_CAMERA_WAIT_S
from robot.errors import DeviceError
from robot.settings import TypedSettings, bounded


def import_package(package: str, device: str, install: str) -> Any:
    """Import a vendor's package; raise DeviceError if it or a system library is missing.

    Args:
        package: Name of the package.
        device: Name of the device, for the message.
        install: How to install the package.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise DeviceError(
            f"{device} requires {package}, which is missing or incomplete ({error}); {install}"
        ) from error


@dataclass(frozen=True, kw_only=True)
class VendorSettings(TypedSettings):
    """Settings of a camera behind a vendor's package.

    Attributes:
        serial: Serial number of the camera, required if several are connected.
        warmup_frames: Frames dropped after connecting.
        timeout_s: Longest wait for a picture.
    """

    serial: str = ""
    warmup_frames: int = bounded(0, 1000, 5)
    timeout_s: float = bounded(1e-3, MAX_CAMERA_WAIT_S, 3.0, unit="s")


def check_finite(what: str, numbers: Iterable[float]) -> list[float]:
    """Return numbers that a camera reports as floats; raise DeviceError for NaN or infinity."""
    found = [float(each) for each in numbers]
    if not all(map(math.isfinite, found)):
        raise DeviceError(f"{what} must be finite numbers, got {found}; plug the camera in again")
    return found


@contextlib.contextmanager
def vendor_errors(failure: str) -> Iterator[None]:
    """Convert exceptions of a vendor's package into a DeviceError that begins with `failure`; OSError passes."""
    try:
        yield
    except (DeviceError, OSError):
        raise
    except Exception as error:
        raise DeviceError(f"{failure}: {error or type(error).__name__}") from error


class VendorCamera(Camera):
    """A camera behind its vendor's package; `_reported` contains the settings that it reports."""

    _reported: Mapping[str, Any] = {}

    def _settings(self) -> dict[str, Any]:
        return dict(self._reported)

    def _recover(self) -> None:
        """Close the device despite errors, then connect completely or not at all."""
        with contextlib.suppress(DeviceError, OSError):
            self._close()
        try:
            self._connect()
        except BaseException:
            with contextlib.suppress(DeviceError, OSError):
                self._close()
            raise

    def _choose_camera(self, requested: str, connected: Sequence[str]) -> int:
        """Return the index of the camera to open among connected serial numbers; raise DeviceError if not unique."""
        if requested in connected or (not requested and len(connected) == 1):
            return connected.index(requested) if requested else 0
        known = ", ".join(connected) or "none"
        if requested:
            raise DeviceError(f"{self.name} {requested} is not connected; connected: {known}")
        raise DeviceError(f"connect exactly one {self.name}, or set its serial number; connected: {known}")
