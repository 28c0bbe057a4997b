"""The gel camera of LeRobot, with emulated USB cameras; LeRobot's base classes are stubs if it is not installed."""

import sys
import tomllib
from functools import partial
from importlib import import_module

import cv2
import numpy as np
import pytest

from robot.drivers import discover
from robot.errors import RobotConfigError, UnknownName
from robot.real_rig import DRIVERS
from tests.documents import ROOT
from tests.fake_video import FakeVideoDevice, own_threads
from tests.integrations.lerobot_stub import provide_lerobot
from tests.waiting import wait_until

FOLDER = ROOT / "integrations" / "lerobot_camera_gelsight"
QUICK = {"warmup_s": 0.0, "timeout_s": 10.0}


@pytest.fixture(autouse=True)
def _no_thread_is_left():
    yield
    assert not own_threads()


@pytest.fixture(scope="module")
def plugin():
    """Import the package of the distribution, once: LeRobot refuses a second registration."""
    with pytest.MonkeyPatch.context() as patch:
        provide_lerobot(patch)
        patch.syspath_prepend(FOLDER)
        yield import_module("lerobot_camera_gelsight")
        for name in [name for name in sys.modules if name.startswith("lerobot_camera_gelsight")]:
            del sys.modules[name]


@pytest.fixture
def errors(plugin):
    return import_module("lerobot.utils.errors")


@pytest.fixture
def make(plugin, tmp_path, monkeypatch):
    """Return a function that makes the camera of an emulated device."""
    path = tmp_path / "usb-Fake_Gel_7-video-index0"

    def camera(device, settings=QUICK, **config):
        path.touch()
        monkeypatch.setattr(cv2, "VideoCapture", lambda path, backend: device.open(path, backend))
        return plugin.GelSightCamera(plugin.GelSightCameraConfig(device=str(path), settings=settings, **config))

    return camera


def test_lerobot_finds_the_package_the_configuration_and_the_camera(plugin):
    project = tomllib.loads((FOLDER / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["name"] == plugin.__name__  # LeRobot imports installed distributions lerobot_camera_*
    config = import_module("lerobot.cameras").CameraConfig.get_known_choices()["gelsight"]
    assert config is plugin.GelSightCameraConfig
    parent = config.__module__.rpartition(".")[0]  # LeRobot looks there for the name without "Config"
    assert getattr(import_module(parent), config.__name__.removesuffix("Config")) is plugin.GelSightCamera


@pytest.mark.parametrize(
    ("sensor", "size"), [("gelsight", (1280, 960)), ("gelsight_mini", (320, 240)), ("digit", (320, 240))]
)
def test_the_default_size_and_rate_are_those_of_the_driver(make, sensor, size):
    device = FakeVideoDevice(size=size)
    camera = make(device, sensor=sensor)
    driver = DRIVERS["sensors"].resolve(sensor)
    with driver(finger="a", device=camera.config.device, **QUICK) as gel:
        assert gel.read(10).pixels.shape == (camera.height, camera.width, 3)
    assert camera.fps == driver.PRESET["fps"]
    with camera:
        assert camera.read().shape == (camera.height, camera.width, 3)


def test_the_camera_gets_the_frame_rate_and_the_pictures_have_the_requested_size(make):
    device = FakeVideoDevice(size=(64, 48))
    with make(device, sensor="uvc", fps=15, width=32, height=24, settings={**QUICK, "crop": [0.5, 0, 0, 0]}) as camera:
        assert camera.read().shape == (24, 32, 3)
    assert device.values[cv2.CAP_PROP_FPS] == 15.0


def test_async_read_returns_each_frame_once_and_read_latest_again(make):
    device = FakeVideoDevice()
    with make(device, sensor="uvc") as camera:
        first = camera.async_read(timeout_ms=10_000)
        assert not np.array_equal(camera.async_read(timeout_ms=10_000), first)
        device.frozen = True
        for _ in range(2):
            wait_until(lambda: np.array_equal(camera.read_latest(600_000), device.picture(device.pictures)[..., ::-1]))


def read_on(read, **limit):
    """Read until it raises."""
    while True:
        read(**limit)


def test_a_frozen_camera_raises_timeout_errors(make):
    device = FakeVideoDevice()
    with make(device, sensor="uvc", settings={**QUICK, "frozen_s": 600.0}) as camera:
        device.frozen = True
        with pytest.raises(TimeoutError, match="has no new frame after 1 ms"):
            read_on(camera.async_read, timeout_ms=1)
        with pytest.raises(TimeoutError, match="has no frame of the last 20 ms"):
            read_on(camera.read_latest, max_age_ms=20)


def test_an_unplugged_camera_raises_the_reason_and_works_when_it_is_back(make):
    device = FakeVideoDevice()
    with make(device, sensor="uvc") as camera:
        device.dead = True
        with pytest.raises(TimeoutError, match="returned no more pictures"):
            read_on(camera.read_latest)
        assert camera.is_connected
        device.dead = False
        assert camera.read().shape == (6, 8, 3)


def test_a_camera_must_be_connected_once(make, errors):
    camera = make(FakeVideoDevice(), sensor="uvc")
    for use in (camera.read, camera.async_read, camera.read_latest, camera.disconnect):
        with pytest.raises(errors.DeviceNotConnectedError, match=r"usb-Fake.* is not connected; call connect\(\)"):
            use()
    with camera:
        with pytest.raises(errors.DeviceAlreadyConnectedError, match="already connected"):
            camera.connect()
        assert camera.is_connected
    assert not camera.is_connected
    with camera:  # again
        camera.read()


def test_a_camera_that_cannot_be_opened_is_a_connection_error(make):
    device = FakeVideoDevice()
    device.busy = True
    camera = make(device, sensor="uvc")
    with pytest.raises(ConnectionError, match=r"usb-Fake.* cannot be opened; is it used by another program"):
        camera.connect()
    assert not camera.is_connected


def test_wrong_settings_are_refused_without_the_device(make):
    with pytest.raises(UnknownName, match="gelsight_mini"):
        make(FakeVideoDevice(), sensor="gelsite")
    with pytest.raises(ValueError, match="sensor must be gelsight, gelsight_mini, digit or uvc, got"):
        make(FakeVideoDevice(), sensor="tests.replay_rig:FolderSensor")
    with pytest.raises(RobotConfigError, match=r"usb-Fake.* has no setting 'exposur'; known settings: .*exposure"):
        make(FakeVideoDevice(), sensor="uvc", settings={"exposur": 1})


def test_connected_cameras_are_listed(plugin, tmp_path, monkeypatch):
    names = tmp_path / "v4l" / "by-id"
    names.mkdir(parents=True)
    (names / "usb-Gel_7-video-index0").touch()
    monkeypatch.setattr(discover, "find_cameras", partial(discover.find_cameras, tmp_path, tmp_path))
    (found,) = plugin.GelSightCamera.find_cameras()
    assert (found["type"], found["id"]) == ("gelsight", str(names / "usb-Gel_7-video-index0"))
