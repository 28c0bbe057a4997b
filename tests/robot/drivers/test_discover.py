"""Discovery of devices, from a fake /dev and /sys."""

import sys
import tomllib

import pytest

from robot.drivers import discover
from robot.drivers.discover import DiscoveredDevice
from tests.fake_video import FakeRealSense


@pytest.fixture(autouse=True)
def _nothing_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)


@pytest.fixture
def roots(tmp_path):
    """Empty /dev and /sys."""
    for name in ("dev/v4l/by-id", "sys/class/video4linux"):
        (tmp_path / name).mkdir(parents=True)
    return tmp_path / "dev", tmp_path / "sys"


def plug_camera(roots, name, number, label, index="0"):
    dev, sys_root = roots
    (dev / f"video{number}").touch()
    entry = sys_root / "class" / "video4linux" / f"video{number}"
    entry.mkdir()
    (entry / "name").write_text(label + "\n")
    (entry / "index").write_text(index + "\n")
    if name:
        (dev / "v4l" / "by-id" / name).symlink_to(dev / f"video{number}")


def test_cameras_are_found_by_their_stable_names_with_their_own_labels(roots, tmp_path):
    assert discover.discover(tmp_path / "none", tmp_path / "none") == []
    plug_camera(roots, "usb-Maker_Webcam_12-video-index0", 0, "Webcam 12: Webcam")
    plug_camera(roots, "usb-Maker_Webcam_12-video-index1", 1, "Webcam 12: Webcam", index="1")
    name = str(roots[0] / "v4l" / "by-id" / "usb-Maker_Webcam_12-video-index0")
    toml = f'driver = "uvc"\ndevice = "{name}"'
    assert discover.discover(*roots) == [DiscoveredDevice("camera", name, "Webcam 12: Webcam", toml)]


@pytest.mark.parametrize(
    ("name", "label", "driver"),
    [
        ("usb-Facebook_DIGIT_D20001-video-index0", "DIGIT: DIGIT", "digit"),
        ("usb-Arducam_x-video-index0", "GelSight Mini R0B 28J4-KK2Q", "gelsight_mini"),
        ("usb-GelSight_A-video-index0", "USB Camera", "gelsight"),
        ("usb-046d_HD_Pro-video-index0", "HD Pro Webcam", "uvc"),
    ],
)
def test_gel_sensors_are_recognised_by_their_names(roots, name, label, driver):
    plug_camera(roots, name, 0, label)
    assert tomllib.loads(discover.discover(*roots)[0].toml)["driver"] == driver


def test_without_stable_names_cameras_are_found_by_number(roots):
    plug_camera(roots, None, 2, "Webcam")
    plug_camera(roots, None, 3, "Webcam", index="1")
    (found,) = discover.discover(*roots)
    assert tomllib.loads(found.toml) == {"driver": "uvc", "device": str(roots[0] / "video2")}


def test_a_camera_without_a_name_of_its_own_is_named_by_its_socket(roots):
    dev = roots[0]
    plug_camera(roots, "usb-Maker_Gel-video-index0", 2, "Gel")
    plug_camera(roots, None, 0, "Gel")
    by_path = dev / "v4l" / "by-path"
    by_path.mkdir()
    links = (("usb-0:1:1.0", 0), ("usbv2-0:1:1.0", 0), ("usb-0:2:1.0", 2))  # newer systems name a socket twice
    for name, number in links:
        (by_path / f"pci-{name}-video-index0").symlink_to(dev / f"video{number}")
    own, socket = str(dev / "v4l/by-id/usb-Maker_Gel-video-index0"), str(by_path / "pci-usb-0:1:1.0-video-index0")
    assert discover.camera_names(dev) == [own, socket]
    assert [(each.device, each.label) for each in discover.find_cameras(*roots)] == [(own, "Gel"), (socket, "Gel")]


def test_depth_cameras_are_listed_by_their_installed_packages(roots, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", FakeRealSense(serials=("8", "9")))
    found = discover.discover(*roots)
    assert [(each.kind, each.device) for each in found] == [("realsense", "8"), ("realsense", "9")]
    assert tomllib.loads(found[1].toml) == {"driver": "realsense", "serial": "9"}


def test_a_failing_package_gives_a_warning_and_hides_nothing_else(roots, monkeypatch, caplog):
    broken = FakeRealSense()
    broken.context = lambda: (_ for _ in ()).throw(RuntimeError("no udev rules"))
    monkeypatch.setitem(sys.modules, "pyrealsense2", broken)
    plug_camera(roots, "usb-Maker_Webcam_12-video-index0", 0, "Webcam")
    assert [each.kind for each in discover.discover(*roots)] == ["camera"]
    assert "RealSense cameras could not be listed: no udev rules" in caplog.text
