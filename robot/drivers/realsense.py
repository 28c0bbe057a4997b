"""Intel RealSense through pyrealsense2: colour, and depth aligned to the colour camera.

Facts used (librealsense): depth is in units of the sensor's depth scale (m), 0 where unknown. `align` maps it to the
colour stream's pixels. Pixel coordinates count from the centre of the first pixel. Automatic exposure settles within
about 30 pictures.
"""

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from robot.devices import Camera, Clock
from robot.drivers.usb_camera.stream import MAX_CAMERA_WAIT_S
from robot.errors import DeviceError
from robot.extras import import_extra
from robot.readings import RGBD, Intrinsics
from robot.settings import TypedSettings


@dataclass(frozen=True, kw_only=True)
class RealSenseSettings(TypedSettings):
    """Settings of both streams of a RealSense.

    Attributes:
        serial: Serial number of the camera, required if several are connected.
        warmup_frames: Frames dropped after connecting.
        timeout_s: Longest wait for a picture.
    """

    serial: str = ""
    width: Annotated[int, Meta(ge=1, le=20_000)] = 640
    height: Annotated[int, Meta(ge=1, le=20_000)] = 480
    fps: Annotated[int, Meta(ge=1, le=1000)] = 30
    warmup_frames: Annotated[int, Meta(ge=0, le=1000)] = 30
    timeout_s: Annotated[float, Meta(ge=1e-3, le=MAX_CAMERA_WAIT_S)] = 3.0


class RealSense(Camera):
    """A RealSense depth camera; the fields of RealSenseSettings are keyword arguments of the constructor.

    `settings` reports the distortion of the colour lens, which is not corrected: a few pixels in the corners.
    """

    Settings = RealSenseSettings

    def __init__(self, *, extrinsics: npt.ArrayLike, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Check the settings without using the device; raise RobotConfigError for one out of range."""
        super().__init__("realsense", extrinsics, clock=clock)
        self._options = RealSenseSettings(**settings)
        self._pipeline: Any = None
        self._align: Any = None
        self._intrinsics: Intrinsics | None = None
        self._scale_m = 0.0
        self._reported: dict[str, Any] = {}

    def _connect(self) -> None:
        rs = import_extra("pyrealsense2", "a RealSense camera", "realsense", DeviceError)
        serial = self._choose(
            [str(device.get_info(rs.camera_info.serial_number)) for device in rs.context().query_devices()]
        )
        pipeline = rs.pipeline()
        config, size = rs.config(), (self._options.width, self._options.height)
        config.enable_device(serial)
        config.enable_stream(rs.stream.depth, *size, rs.format.z16, self._options.fps)
        config.enable_stream(rs.stream.color, *size, rs.format.rgb8, self._options.fps)
        profile = pipeline.start(config)
        self._pipeline = pipeline  # now `_close` stops it
        self._align = rs.align(rs.stream.color)
        self._read_parameters(rs, profile, serial)
        for _ in range(self._options.warmup_frames):
            self._wait()

    def _choose(self, connected: Sequence[str]) -> str:
        """Return the serial number of the camera to open; raise DeviceError if it is not unique or not connected."""
        serial, known = self._options.serial, ", ".join(connected) or "none"
        if serial and serial not in connected:
            raise DeviceError(f"realsense {serial} is not connected; connected: {known}")
        if not serial and len(connected) != 1:
            raise DeviceError(f"connect exactly one realsense, or set its serial number; connected: {known}")
        return serial or connected[0]

    def _read_parameters(self, rs: Any, profile: Any, serial: str) -> None:
        """Read the depth scale and the intrinsics."""
        video = profile.get_stream(rs.stream.color).as_video_stream_profile()
        lens = video.get_intrinsics()
        self._scale_m = float(profile.get_device().first_depth_sensor().get_depth_scale())
        self._intrinsics = Intrinsics(lens.fx, lens.fy, lens.ppx, lens.ppy)
        self._reported = {
            "serial": serial,
            "width": int(lens.width),
            "height": int(lens.height),
            "fps": int(video.fps()),
            "depth_scale_m": self._scale_m,
            "distortion": list(map(float, lens.coeffs)),
        }

    def _settings(self) -> dict[str, Any]:
        return dict(self._reported)

    def _close(self) -> None:
        pipeline, self._pipeline = self._pipeline, None
        if pipeline is not None:
            pipeline.stop()

    def _recover(self) -> None:
        """Close the camera despite errors, then connect; a failed recovery can be repeated."""
        with contextlib.suppress(Exception):
            self._close()
        self._connect()

    def _wait(self) -> Any:
        try:
            return self._pipeline.wait_for_frames(round(1000 * self._options.timeout_s))
        except RuntimeError as error:
            raise DeviceError(f"realsense returned no picture: {error}; is it plugged into USB 3?") from error

    def _read(self, depth: bool) -> RGBD:
        if self._pipeline is None:
            raise DeviceError("realsense was stopped by a failed recovery; call recover() again")
        self._pipeline.poll_for_frames()  # drops frames taken before this call
        frames = self._wait()
        time_s = self.clock()
        if depth:
            frames = self._align.process(frames)
        colour = np.array(frames.get_color_frame().get_data())  # a copy: the package reuses the memory
        raw = np.array(frames.get_depth_frame().get_data()) if depth else None
        depth_m = None if raw is None else np.where(raw > 0, raw * np.float32(self._scale_m), np.float32(np.nan))
        return RGBD(colour, depth_m, self._intrinsics, time_s)
