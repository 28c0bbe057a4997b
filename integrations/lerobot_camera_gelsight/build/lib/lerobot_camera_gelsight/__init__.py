"""Gel sensors as cameras of LeRobot: `type: gelsight` in `--robot.cameras`."""

from lerobot_camera_gelsight.camera import GelSightCamera as GelSightCamera
from lerobot_camera_gelsight.camera import GelSightCameraConfig as GelSightCameraConfig

__all__ = ["GelSightCamera", "GelSightCameraConfig"]
