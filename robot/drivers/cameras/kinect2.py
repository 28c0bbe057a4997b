"""Kinect 2 through pylibfreenect2: depth, and the colour of each of its 512 x 424 pixels.

Facts used (libfreenect2, pylibfreenect2): depth is float in mm, 0 or infinite where unknown. `Registration.apply`
returns undistorted depth and the colour of each of its pixels (BGRX, black where unknown). The intrinsics are then the
parameters of the infrared camera, available after start(). Each set of frames must be released before the next one
arrives. Opening an unknown serial number crashes the process, so the serial numbers are listed first. A device refers
to its listener and its Freenect2, so Python references to both must live as long as the device.
"""

import contextlib
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from robot.devices import Clock
from robot.drivers.discover import decode_serial
from robot.drivers.vendor import VendorCamera, VendorSettings, import_package, vendor_errors
from robot.errors import DeviceError
from robot.readings import RGBD, Intrinsics

WIDTH, HEIGHT = 512, 424
_PIPELINES = ("OpenGLPacketPipeline", "OpenCLPacketPipeline", "CudaPacketPipeline", "CpuPacketPipeline")
"""Processors of the depth, in order of preference; a build of libfreenect2 may lack all but the last."""

_POLL_S = 0.002


class Kinect2(VendorCamera):
    """A Kinect 2; the fields of VendorSettings are keyword arguments of the constructor."""

    Settings = VendorSettings

    def __init__(self, *, extrinsics: npt.ArrayLike, clock: Clock = time.monotonic, **settings: Any) -> None:
        """Check the settings without using the device; raise RobotConfigError for one out of range."""
        super().__init__("kinect2", extrinsics, clock=clock)
        self._options = VendorSettings(**settings)
        self._package: Any = None
        self._freenect: Any = None
        self._device: Any = None
        self._listener: Any = None
        self._registration: Any = None
        self._intrinsics: Intrinsics | None = None

    def _connect(self) -> None:
        install = (
            "build libfreenect2 with shared libraries first (github.com/OpenKinect/libfreenect2), "
            "then run pip install pylibfreenect2"
        )
        package = self._package = import_package("pylibfreenect2", "a Kinect 2", install)
        with vendor_errors("kinect2 cannot be started"):
            self._freenect = package.Freenect2()
            count = self._freenect.enumerateDevices()
            serials = list(map(self._freenect.getDeviceSerialNumber, range(count)))  # bytes or text
            serial = serials[self._choose_camera(self._options.serial, list(map(decode_serial, serials)))]
            name, pipeline = self._make_pipeline()
            self._device = self._freenect.openDevice(serial, pipeline=pipeline)
            self._listener = package.SyncMultiFrameListener(package.FrameType.Color | package.FrameType.Depth)
            self._device.setColorFrameListener(self._listener)
            self._device.setIrAndDepthFrameListener(self._listener)
            self._device.start()
            self._read_parameters(decode_serial(serial), name)
            for _ in range(self._options.warmup_frames):
                with self._frames():
                    pass

    def _make_pipeline(self) -> tuple[str, Any]:
        """Return the first pipeline that this build has and this computer can run."""
        failures = []
        for name in _PIPELINES:
            try:
                return name, getattr(self._package, name)()
            except Exception as error:
                failures.append(f"{name}: {error}")
        raise DeviceError(f"kinect2 has no usable pipeline: {'; '.join(failures)}")

    def _read_parameters(self, serial: str, pipeline: str) -> None:
        infrared = self._device.getIrCameraParams()
        self._registration = self._package.Registration(infrared, self._device.getColorCameraParams())
        self._intrinsics = Intrinsics(*(float(getattr(infrared, name)) for name in ("fx", "fy", "cx", "cy")))
        self._reported = {"serial": serial, "pipeline": pipeline, "width": WIDTH, "height": HEIGHT}

    def _close(self) -> None:
        device, self._device = self._device, None
        try:
            if device is not None:
                with vendor_errors("kinect2 cannot be stopped"):
                    try:
                        device.stop()
                    finally:
                        device.close()
        finally:
            self._listener = self._registration = self._freenect = None

    @contextlib.contextmanager
    def _frames(self) -> Iterator[Any]:
        """Yield a set of frames and release it; poll, because some versions of the package have no timeout."""
        if self._device is None:
            raise DeviceError("kinect2 was stopped by a failed recovery; call recover() again")
        deadline = time.monotonic() + self._options.timeout_s
        while not self._listener.hasNewFrame():
            if time.monotonic() > deadline:
                raise DeviceError(
                    f"kinect2 returned no picture within {self._options.timeout_s:g} s; "
                    "it requires USB 3 and its own power supply"
                )
            time.sleep(_POLL_S)
        frames = self._listener.waitForNewFrame()
        try:
            yield frames
        finally:
            self._listener.release(frames)

    def _read(self, depth: bool) -> RGBD:
        with vendor_errors("kinect2 returned no picture"):
            if self._device is not None and self._listener.hasNewFrame():
                with self._frames():
                    pass  # it may be as old as the last read
            with self._frames() as frames:
                time_s = self.clock()
                undistorted, registered = (self._package.Frame(WIDTH, HEIGHT, 4) for _ in range(2))
                self._registration.apply(frames["color"], frames["depth"], undistorted, registered)
                # Copies, because the package reuses the memory.
                colour = np.array(registered.asarray(np.uint8)[:, :, 2::-1])
                depth_mm = np.array(undistorted.asarray(np.float32))
        known = np.isfinite(depth_mm) & (depth_mm > 0)
        depth_m = np.where(known, depth_mm, np.float32(np.nan)) * np.float32(1e-3)
        return RGBD(colour, depth_m if depth else None, self._intrinsics, time_s)
