"""Cameras of the table: RealSense with a fake of its package, and a plain USB camera."""

import sys

import cv2
import numpy as np
import pytest

from robot.drivers import discover
from robot.drivers.realsense import RealSense
from robot.drivers.usb_camera.driver import UvcCamera
from robot.errors import DeviceError
from tests import views
from tests.fake_video import FakeRealSense, FakeVideoDevice, own_threads


@pytest.fixture
def install(monkeypatch):
    """Return a function that installs a fake package."""

    def installed(fake):
        monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
        return fake

    return installed


def realsense(**more):
    return RealSense(extrinsics=views.camera_pose(), **{"warmup_frames": 3, **more})


def test_a_realsense_returns_colour_and_depth_in_metres_with_its_intrinsics(install):
    rs = install(FakeRealSense())
    with realsense() as eye:
        rs.waiting = 9  # a picture taken before the read, which is skipped
        image = eye.read()
        np.testing.assert_allclose(image.depth_m, [[np.nan, 0.5, 0.5, 1.0]] * 3, rtol=1e-6)
        assert image.depth_m.dtype == np.float32
        assert image.colour[0].tolist() == [[0, 1, 0], [10, 1, 0], [20, 1, 0], [30, 1, 0]]
        lens = image.intrinsics
        assert (lens.fx, lens.fy, lens.cx, lens.cy) == (10.0, 11.0, 1.5, 1.0)
        assert eye.settings()["depth_scale_m"] == 0.0005
    assert rs.started == ["123"]
    assert rs.streams == [("depth", 640, 480, "z16", 30), ("colour", 640, 480, "rgb8", 30)]
    assert rs.stopped == 1


@pytest.mark.parametrize(
    ("serials", "requested", "message"),
    [
        (("1", "2"), "", "or set its serial number; connected: 1, 2"),
        (("1", "2"), "3", "realsense 3 is not connected; connected: 1, 2"),
    ],
)
def test_an_ambiguous_or_missing_realsense_raises(install, serials, requested, message):
    rs = install(FakeRealSense(serials=serials))
    with pytest.raises(DeviceError, match=message):
        realsense(serial=requested).connect()
    assert rs.started == []


def test_a_silent_realsense_is_an_error_and_can_be_started_again(install):
    rs = install(FakeRealSense())
    with realsense() as eye:
        rs.silent = True
        with pytest.raises(DeviceError, match=r"realsense returned no picture.*Frame didn't arrive within 3000"):
            eye.read()
        with pytest.raises(DeviceError, match="realsense cannot recover"):
            eye.recover()
        with pytest.raises(DeviceError, match=r"call recover\(\) again"):
            eye.read()
        rs.silent = False
        eye.recover()
        eye.read()
    assert rs.stopped == 2


def test_a_missing_system_library_is_named(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    (tmp_path / "pyrealsense2.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open shared object file')")
    with pytest.raises(DeviceError, match=r"pyrealsense2, which is missing or incomplete \(libusb-1\.0\.so\.0"):
        realsense().connect()


def test_a_plain_camera_returns_colour_has_no_depth_and_may_hang_upside_down(tmp_path, monkeypatch):
    camera, name = FakeVideoDevice(), tmp_path / "usb-Webcam-video-index0"
    monkeypatch.setattr(cv2, "VideoCapture", camera.open)
    monkeypatch.setattr(discover, "DEV", tmp_path)
    name.touch()
    settings = {"device": str(name), "extrinsics": views.camera_pose(), "warmup_s": 0.0}
    with UvcCamera(width=640, height=480, **settings) as eye:
        image = eye.read(depth=False, max_age_s=10)
        assert (image.depth_m, image.intrinsics) == (None, None)
        assert (image.colour[0, :, 0] == 200).all()
        with pytest.raises(DeviceError, match="has no depth: read it with depth=False"):
            eye.read()
        assert (cv2.CAP_PROP_AUTO_EXPOSURE, 3) in camera.written  # automatic
        assert eye.refused == {}
    with UvcCamera(upside_down=True, **settings) as eye:
        colour = eye.read(depth=False, max_age_s=10).colour
    assert (colour[-1, :, 0] == 200).all()
    assert (colour[:-1, :, 0] == 100).all()
    assert not camera.open_captures
    assert not own_threads()
