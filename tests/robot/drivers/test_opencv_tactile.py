"""Gel sensors through OpenCV: the camera's name, its settings, its pictures, and recovery."""

import json
import math

import cv2
import numpy as np
import pytest

from robot.drivers import discover
from robot.drivers.usb_camera.driver import Digit, GelSight, GelSightMini, OpencvTactile, crop_and_resize
from robot.drivers.usb_camera.stream import CaptureStream, UsbCameraSettings, stable_path
from robot.errors import DeviceError, RobotConfigError
from tests.fake_video import FakeVideoDevice, own_threads
from tests.waiting import wait_until

QUICK = {"warmup_s": 0.0, "timeout_s": 10.0}


@pytest.fixture(autouse=True)
def _no_thread_is_left():
    yield
    assert not own_threads()


@pytest.fixture
def dev(tmp_path, monkeypatch):
    """Empty /dev."""
    (tmp_path / "v4l" / "by-id").mkdir(parents=True)
    monkeypatch.setattr(discover, "DEV", tmp_path)
    return tmp_path


@pytest.fixture
def plug(dev, monkeypatch):
    """Return a function that connects a camera under a stable name, at a number, and returns the name."""
    cameras = {}
    monkeypatch.setattr(cv2, "VideoCapture", lambda path, backend: cameras[path].open(path, backend))

    def plugged(camera, name="usb-Fake_Gel_7-video-index0", number=0):
        node, link = dev / f"video{number}", dev / "v4l" / "by-id" / name
        node.touch()
        link.unlink(missing_ok=True)
        link.symlink_to(node)
        cameras[str(node)] = camera
        return str(link)

    return plugged


@pytest.mark.parametrize("device", ["/dev/video2", "/dev//video2", "/dev/v4l/by-id/../../video2"])
def test_a_camera_named_by_a_number_is_refused_with_the_names_of_those_connected(plug, device):
    name = plug(FakeVideoDevice())
    with pytest.raises(RobotConfigError, match=f"another camera may have after a restart. Connected: {name}$"):
        OpencvTactile(finger="a", device=device)


def test_a_camera_has_a_number_only_where_no_name_is_stable_and_a_missing_one_is_named(plug, dev):
    assert stable_path("/dev/video3") == "/dev/video3"
    with pytest.raises(RobotConfigError, match="absolute path, got '3'"):
        stable_path("3")
    name = plug(FakeVideoDevice())
    with pytest.raises(DeviceError, match=f"usb-Other does not exist.*Connected: {name}"):
        OpencvTactile(finger="a", device=str(dev / "v4l" / "by-id" / "usb-Other")).connect()


def test_a_camera_in_use_cannot_be_connected_and_can_be_later(plug, dev):
    camera = FakeVideoDevice()
    gel = OpencvTactile(finger="a", device=plug(camera, number=4), **QUICK)
    camera.busy = True
    with pytest.raises(DeviceError, match="cannot be opened; is it used by another program"):
        gel.connect()
    assert not gel.is_connected
    assert not camera.open_captures
    camera.busy = False
    with gel:
        gel.read(10)
        assert camera.captures[-1].path == str(dev / "video4")
        assert camera.captures[-1].backend == cv2.CAP_V4L2
    assert not camera.open_captures


def test_settings_are_written_with_the_format_first_and_read_back(plug):
    camera = FakeVideoDevice()
    requested = {"exposure_ms": 5.0, "white_balance_k": 4600.0, "gain": 0.0}
    with GelSight(finger="a", device=plug(camera), **requested, **QUICK) as gel:
        assert camera.written == [
            (cv2.CAP_PROP_FOURCC, 0x47504A4D),  # "MJPG", first letter lowest
            (cv2.CAP_PROP_FRAME_WIDTH, 1280),
            (cv2.CAP_PROP_FRAME_HEIGHT, 960),
            (cv2.CAP_PROP_FPS, 30),
            (cv2.CAP_PROP_AUTO_EXPOSURE, 1),  # manual
            (cv2.CAP_PROP_EXPOSURE, 50),  # 0.1 ms each
            (cv2.CAP_PROP_AUTO_WB, 0),
            (cv2.CAP_PROP_WB_TEMPERATURE, 4600),
            (cv2.CAP_PROP_GAIN, 0),
        ]
        assert gel.refused == {}
        found = json.loads(json.dumps(gel.settings()))
    assert (found["fourcc"], found["width"], found["height"], found["fps"]) == ("MJPG", 1280, 960, 30.0)
    assert (found["auto_exposure"], found["exposure_ms"], found["auto_white_balance"]) == (False, 5.0, False)
    assert found["picture_px"] == [8, 6]  # the size of the actual pictures
    assert found["device"].endswith("video-index0")


def test_settings_that_the_camera_refuses_are_reported_with_the_actual_values(plug):
    camera = FakeVideoDevice(stubborn=[cv2.CAP_PROP_FPS, cv2.CAP_PROP_FOURCC], lacks=[cv2.CAP_PROP_EXPOSURE])
    with GelSight(finger="a", device=plug(camera), exposure_ms=5.0, **QUICK) as gel:
        assert gel.refused == {
            "fourcc": "requested MJPG, has YUYV",
            "fps": "requested 30, has 15",
            "exposure_ms": "requested 5, has no such setting",
        }
        assert gel.settings()["fps"] == 15.0


def test_the_zoom_control_of_a_digit_sets_its_brightness(plug):
    camera = FakeVideoDevice()
    with Digit(finger="a", device=plug(camera), led=[15, 2, 1], **QUICK) as gel:
        assert (cv2.CAP_PROP_ZOOM, 0xF21) in camera.written
        assert gel.settings()["led"] == [15, 2, 1]
        assert gel.refused == {}


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"width": 640}, "width and height"),
        ({"exposure_ms": 5.0, "auto_exposure": True}, "exposure_ms must be left out"),
        ({"led": [1, 2, 16]}, "led"),
        ({"crop": [0.5, 0.0, 0.5, 0.0]}, "crop"),
        ({"timeout_s": math.inf}, "timeout_s"),
    ],
)
def test_settings_out_of_range_are_refused_before_connecting(setting, message):
    with pytest.raises(RobotConfigError, match=message):
        OpencvTactile(finger="a", device="/dev/v4l/by-id/usb-Gel", **setting)


def test_pictures_are_rgb_with_row_0_on_top_and_that_of_a_digit_is_rotated_to_the_left(plug):
    """The camera's first row becomes the left column, as after transposing and flipping."""
    with OpencvTactile(finger="a", device=plug(FakeVideoDevice()), **QUICK) as gel:
        pixels = gel.read(10).pixels
    with Digit(finger="a", device=plug(FakeVideoDevice()), **QUICK) as gel:
        turned = gel.read(10).pixels
    assert pixels[:, 0].tolist() == [[200, 50, pixels[0, 0, 2]], *[[100, 50, pixels[0, 0, 2]]] * 5]
    assert turned.shape == (8, 6, 3)
    assert (turned[:, 0, 0] == 200).all()
    assert (turned[:, 1:, 0] == 100).all()


def test_the_picture_of_a_gelsight_mini_is_cropped_and_resized(plug):
    camera = FakeVideoDevice(size=(100, 80))
    with GelSightMini(finger="a", device=plug(camera), **QUICK) as gel:
        assert gel.read(10).pixels.shape == (56, 70, 3)  # 80 - 2 * 12 by 100 - 2 * 15


def test_cropping_keeps_the_pixels_and_shrinking_takes_the_means():
    picture = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    np.testing.assert_array_equal(crop_and_resize(picture, (0.2, 0.25, 0.4, 0.0), None), picture[1:, 1:3])
    assert crop_and_resize(picture, (0.9, 0.9, 0.0, 0.0), None).shape == (1, 1, 3)  # never empty
    stripes = np.tile(np.uint8([0, 200]), (4, 4))[..., None].repeat(3, 2)
    assert set(crop_and_resize(stripes, (0.0,) * 4, (4, 2)).ravel().tolist()) == {100}
    assert set(stripes[::2, ::2].ravel().tolist()) == {0}  # every second pixel would show only the dark stripes


@pytest.mark.parametrize(("make", "shape"), [(OpencvTactile, (6, 8, 2)), (Digit, (6, 8)), (GelSightMini, (6, 8, 4))])
def test_pictures_without_three_colours_are_a_device_error_with_the_remedy(plug, make, shape):
    camera = FakeVideoDevice()
    camera.picture = lambda number: np.full(shape, number % 256, np.uint8)
    with pytest.raises(DeviceError, match=r'must return pictures H x W x 3 uint8, .*such as "MJPG"'):
        make(finger="a", device=plug(camera), **QUICK).connect()


def test_the_time_of_a_picture_is_that_at_which_its_buffer_was_filled(plug):
    camera = FakeVideoDevice()
    stream = CaptureStream(plug(camera), UsbCameraSettings(device="gel"), lambda: 1e6)
    capture = camera.captures[0]
    for taken_s, expected_s in ((1e6 - 0.03, 1e6 - 0.03), (1e6 - 2.0, 1e6), (1e6 + 1.0, 1e6), (0.0, 1e6)):
        capture.grab = lambda taken_s=taken_s: setattr(capture, "taken_s", taken_s) or True
        assert stream.next().time_s == pytest.approx(expected_s, abs=1e-6)
    stream.close()


def test_a_few_damaged_pictures_are_skipped_and_many_are_a_lost_stream(plug):
    camera = FakeVideoDevice(fps=1000.0)
    stream = CaptureStream(plug(camera), UsbCameraSettings(device="gel"), lambda: 0.0)
    for _ in range(2):  # a valid picture resets the count
        camera.damaged = 10
        assert stream.next().pixels.shape == (6, 8, 3)
    camera.damaged = 11
    with pytest.raises(DeviceError, match="returned no more pictures"):
        stream.next()
    stream.close()


@pytest.mark.parametrize("method", ["grab", "retrieve", "set"])
def test_an_exception_of_opencv_is_a_device_error(plug, method, monkeypatch):
    camera = FakeVideoDevice()
    name = plug(camera)

    def fail(*_):
        raise cv2.error("Unknown error")

    monkeypatch.setattr("tests.fake_video.FakeCapture." + method, fail)
    with pytest.raises(DeviceError, match="OpenCV failed"):
        CaptureStream(name, UsbCameraSettings(device="gel"), lambda: 0.0).next()
    if method == "set":
        assert not camera.open_captures


def test_a_camera_reconnected_under_another_number_gets_its_settings_again(plug):
    first, second = FakeVideoDevice(stubborn=[cv2.CAP_PROP_FRAME_WIDTH]), FakeVideoDevice(stubborn=[cv2.CAP_PROP_FPS])
    with GelSight(finger="a", device=plug(first, number=0), **QUICK) as gel:
        gel.read(10)
        assert gel.refused == {"width": "requested 1280, has 0"}
        plug(second, number=1)
        first.dead = True
        gel.recover()
        assert gel.read(10).pixels.shape == (6, 8, 3)
        assert gel._reader.lost_count >= 1
        assert [number for number, _ in second.written[:3]] == [number for number, _ in first.written[:3]]
        assert gel.refused == {"fps": "requested 30, has 15"}
    assert not first.open_captures
    assert not second.open_captures


def test_a_frozen_camera_is_an_error(plug):
    camera = FakeVideoDevice()
    with OpencvTactile(finger="a", device=plug(camera), warmup_s=0.0, timeout_s=0.3, frozen_s=0.05) as gel:
        camera.frozen = True
        wait_until(lambda: gel._reader.lost_count)
        with pytest.raises(DeviceError, match="frozen: the same picture"):
            gel.recover()
        camera.frozen = False
        gel.recover()
        gel.read(10)
