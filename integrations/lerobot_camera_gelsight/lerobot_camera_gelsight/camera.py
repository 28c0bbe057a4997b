"""A LeRobot camera over the gel drivers of touch-retrieval.

LeRobot finds the configuration by `type: gelsight` and the camera by the configuration's name without "Config".
"""

import logging
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from lerobot.cameras import Camera, CameraConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from robot.drivers import discover
from robot.drivers.usb_camera.driver import OpencvTactile
from robot.errors import DeviceError
from robot.real_rig import DRIVERS
from robot.settings import build

log = logging.getLogger(__name__)
Picture = npt.NDArray[np.uint8]
"""(H, W, 3) uint8, RGB."""

_DEFAULTS = {"gelsight": (30, 1280, 960), "gelsight_mini": (25, 224, 168), "digit": (60, 240, 320)}
"""Frame rate, width and height of a sensor's pictures after the driver's rotation and crop."""

_READ_TIMEOUT_MS = 10_000.0
"""Longest wait of `read`, as in LeRobot's own cameras."""


@CameraConfig.register_subclass("gelsight")
@dataclass(kw_only=True)
class GelSightCameraConfig(CameraConfig):
    """Configuration of a gel camera.

    Attributes:
        device: Stable path of the camera, such as /dev/v4l/by-id/usb-...-video-index0.
        sensor: Driver of touch-retrieval: gelsight, gelsight_mini, digit, or uvc for any other gel.
        fps: Frame rate of the camera; by default that of the sensor.
        width: Width of the pictures that LeRobot records; the driver's picture is resized to it.
        height: Height of these pictures. Both have a default for every sensor except uvc.
        settings: Further settings of the driver, such as crop, exposure_ms or timeout_s.
    """

    device: str
    sensor: str = "gelsight_mini"
    fps: int | None = None
    width: int | None = None
    height: int | None = None
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Fill in the sensor's frame rate and picture size."""
        fps, width, height = _DEFAULTS.get(self.sensor, (None, None, None))
        self.fps, self.width, self.height = self.fps or fps, self.width or width, self.height or height


class GelSightCamera(Camera):
    """A gel sensor as a camera of LeRobot.

    A thread of the driver reads all frames. A frozen or unplugged camera raises TimeoutError with the reason; the
    driver opens it again when it is back. A frame equal to the previous one does not count as new.
    """

    def __init__(self, config: GelSightCameraConfig) -> None:
        """Check the settings without using the device.

        Raises:
            UnknownName: There is no such driver.
            RobotConfigError: A setting is unknown or invalid.
            ValueError: The driver is not one of a gel with a USB camera.
        """
        super().__init__(config)
        self.config = config
        driver = DRIVERS["sensors"].resolve(config.sensor)
        if not issubclass(driver, OpencvTactile):
            raise ValueError(f"sensor must be gelsight, gelsight_mini, digit or uvc, got {config.sensor!r}")
        table: dict[str, Any] = {"device": config.device, **config.settings}
        if config.fps:
            table["fps"] = float(config.fps)
        if config.width and config.height:
            table["output_px"] = [config.width, config.height]
        self._sensor = build(driver, table, where=str(self), finger="a")
        self._last_s = -math.inf

    def __str__(self) -> str:
        return f"GelSightCamera({self.config.device})"

    @property
    def is_connected(self) -> bool:
        """Whether the camera was connected; also true while the driver opens a lost camera again."""
        return self._sensor.is_connected

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Return the connected USB cameras: `id` is the `device` of the configuration."""
        return [{"name": each.label, "type": "gelsight", "id": each.device} for each in discover.find_cameras()]

    def connect(self, warmup: bool = True) -> None:
        """Open the camera and wait for a frame.

        Args:
            warmup: Ignored. The driver always drops the frames of its setting `warmup_s`.

        Raises:
            DeviceAlreadyConnectedError: The camera is connected.
            ConnectionError: The camera cannot be opened or returns no picture.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected; call disconnect() first")
        try:
            self._sensor.connect()
            self.width, self.height = self._sensor.settings()["picture_px"]
        except DeviceError as error:
            raise ConnectionError(f"{self}: {error}") from error
        for name, refusal in self._sensor.refused.items():
            log.warning("%s: the camera refused the setting %s: %s", self, name, refusal)

    def read(self) -> Picture:
        """Wait for the next frame and return it; raise TimeoutError after 10 s."""
        return self._read_new(self._sensor.clock(), _READ_TIMEOUT_MS)

    def async_read(self, timeout_ms: float = 200) -> Picture:
        """Return the newest frame that `read` and `async_read` have not returned yet, and wait for it if necessary.

        Raises:
            DeviceNotConnectedError: The camera is not connected.
            TimeoutError: No such frame arrived within `timeout_ms`.
        """
        return self._read_new(self._last_s, timeout_ms)

    def read_latest(self, max_age_ms: int = 500) -> Picture:
        """Return the newest frame without waiting; later calls may return it again.

        Raises:
            DeviceNotConnectedError: The camera is not connected.
            TimeoutError: The newest frame is older than `max_age_ms`, or the camera is lost.
        """
        self._check_connected()
        try:
            return self._sensor.read_after(self._sensor.clock() - max_age_ms / 1000, 0.0).pixels
        except DeviceError as error:
            raise TimeoutError(f"{self} has no frame of the last {max_age_ms:g} ms: {error}") from error

    def disconnect(self) -> None:
        """Close the camera.

        Raises:
            DeviceNotConnectedError: The camera is not connected.
            ConnectionError: The camera's driver does not return.
        """
        self._check_connected()
        try:
            self._sensor.close()
        except DeviceError as error:
            raise ConnectionError(f"{self}: {error}") from error

    def _read_new(self, after_s: float, timeout_ms: float) -> Picture:
        self._check_connected()
        try:
            frame = self._sensor.read_after(after_s, timeout_ms / 1000)
        except DeviceError as error:
            raise TimeoutError(f"{self} has no new frame after {timeout_ms:g} ms: {error}") from error
        self._last_s = frame.time_s
        return frame.pixels

    def _check_connected(self) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first")
