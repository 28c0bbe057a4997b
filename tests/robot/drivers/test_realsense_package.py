"""The RealSense driver with the real pyrealsense2 and its software device: frames, alignment and lens are real."""

from types import SimpleNamespace

import numpy as np
import pytest

from robot.drivers import realsense
from robot.drivers.discover import discover
from robot.drivers.realsense import RealSense
from robot.errors import DeviceError
from tests.fake_video import EXTRINSICS

# The wheel also requires the system's libusb; pytest reports which of the two is missing.
rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
WIDTH, HEIGHT = 64, 48
BARREL = [0.1, 0.0, 0.0, 0.0, 0.0]


class SoftCamera:
    """pyrealsense2 with its software device as a pipeline: each wait returns a new picture of a wall."""

    def __init__(self, coefficients):
        self.coefficients, self.number, self.running = coefficients, 0, False
        self.colour = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        self.colour[..., 0] = np.arange(WIDTH)  # red grows to the right
        self.raw = np.full((HEIGHT, WIDTH), 2000, np.uint16)
        self.raw[:, :10] = 0
        self.device = rs.software_device()
        self.sensors = {
            "depth": self._stream("Depth", rs.stream.depth, rs.format.z16, 2, 1),
            "colour": self._stream("Color", rs.stream.color, rs.format.rgb8, 3, 2),
        }
        straight = rs.extrinsics()
        straight.rotation, straight.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
        self.sensors["depth"][1].register_extrinsics_to(self.sensors["colour"][1], straight)
        self.sensors["depth"][0].add_read_only_option(rs.option.depth_units, 0.0005)
        self.device.create_matcher(rs.matchers.default)
        self.sync = rs.syncer()

    def __getattr__(self, name):
        return getattr(rs, name)

    def lens(self):
        lens = rs.intrinsics()
        lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = WIDTH, HEIGHT, 60, 60, 31.5, 23.5
        lens.model = rs.distortion.inverse_brown_conrady if any(self.coefficients) else rs.distortion.none
        lens.coeffs = self.coefficients
        return lens

    def _stream(self, name, kind, form, size, number):
        stream = rs.video_stream()
        stream.type, stream.fmt, stream.bpp, stream.uid = kind, form, size, number
        stream.width, stream.height, stream.fps, stream.index, stream.intrinsics = WIDTH, HEIGHT, 30, 0, self.lens()
        sensor = self.device.add_sensor(name)
        return sensor, sensor.add_video_stream(stream), size

    def context(self):
        found = SimpleNamespace(get_info={rs.camera_info.serial_number: "77"}.get)
        return SimpleNamespace(query_devices=lambda: [found])

    def config(self):
        return SimpleNamespace(enable_device=lambda serial: None, enable_stream=lambda *args: None)

    def pipeline(self):
        return SimpleNamespace(
            start=self._start, stop=self._stop, wait_for_frames=self._wait, poll_for_frames=self.sync.poll_for_frames
        )

    def _start(self, config):
        for sensor, profile, _ in self.sensors.values():
            sensor.open(profile)
            sensor.start(self.sync)
        depth = SimpleNamespace(get_depth_scale=lambda: 0.0005)
        return SimpleNamespace(
            get_stream=lambda kind: self.sensors["colour"][1],
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: depth),
        )

    def _stop(self):
        for sensor, _, _ in self.sensors.values():
            sensor.stop()
            sensor.close()

    def _wait(self, timeout_ms):
        self.number += 1
        for (sensor, profile, size), pixels in zip(self.sensors.values(), (self.raw, self.colour), strict=True):
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp, frame.stride, frame.frame_number = pixels, size, WIDTH * size, self.number
            frame.timestamp, frame.domain = self.number * 33.0, rs.timestamp_domain.system_time
            frame.profile = profile.as_video_stream_profile()
            sensor.on_video_frame(frame)
        return self.sync.wait_for_frames(timeout_ms)


def connected(monkeypatch, coefficients):
    camera = SoftCamera(coefficients)
    monkeypatch.setattr(realsense, "import_package", lambda *_: camera)
    return RealSense(extrinsics=EXTRINSICS, warmup_frames=2, timeout_s=5.0)


def test_the_real_package_returns_colour_and_depth_unchanged(monkeypatch):
    with connected(monkeypatch, [0.0] * 5) as eye:
        image = eye.read()
        assert eye.read(depth=False).depth_m is None
        lens = image.intrinsics
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (60.0, 60.0, 31.5, 23.5)
    assert image.colour[20, :, 0].tolist() == list(range(WIDTH))
    assert np.isnan(image.depth_m[20, :10]).all()
    np.testing.assert_allclose(image.depth_m[20, 11:-1], 1.0, rtol=1e-6)


def test_a_distorted_lens_is_undistorted_with_the_real_packages_model(monkeypatch):
    """At the middle of the left border x = -31.5 / 60, so the lens shows it at 31.5 - 31.5 (1 + 0.1 x^2) = -0.87."""
    with connected(monkeypatch, BARREL) as eye:
        assert eye.settings()["undistorted"]
        source = eye._undistortion[23]
        colour = eye.read(depth=False).colour
    x, y = -31.5 / 60, -0.5 / 60
    assert source[0, 0] == pytest.approx(31.5 - 31.5 * (1 + 0.1 * (x * x + y * y)), abs=1e-4)
    np.testing.assert_allclose(colour[23, 5:-5, 0], source[5:-5, 0], atol=0.6)  # integer grey levels


def test_without_a_camera_the_real_package_finds_none():
    if any(device.kind == "realsense" for device in discover()):
        pytest.skip("a RealSense camera is connected")
    with pytest.raises(DeviceError, match="connected: none"):
        RealSense(extrinsics=EXTRINSICS).connect()
