"""Discovery of cameras, from a fake /dev and /sys."""

import tomllib

import pytest

from robot.drivers import discover
from robot.drivers.discover import DiscoveredCamera


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
    assert discover.find_cameras(tmp_path / "none", tmp_path / "none") == []
    plug_camera(roots, "usb-Maker_Webcam_12-video-index0", 0, "Webcam 12: Webcam")
    plug_camera(roots, "usb-Maker_Webcam_12-video-index1", 1, "Webcam 12: Webcam", index="1")
    name = str(roots[0] / "v4l" / "by-id" / "usb-Maker_Webcam_12-video-index0")
    toml = f'driver = "uvc"\ndevice = "{name}"'
    assert discover.find_cameras(*roots) == [DiscoveredCamera(name, "Webcam 12: Webcam", toml)]


@pytest.mark.parametrize(
    ("name", "label", "driver"),
    [
        ("usb-Facebook_DIGIT_D20001-video-index0", "DIGIT: DIGIT", "digit"),
        ("usb-Arducam_x-video-index0", "GelSight Mini R0B 28J4-KK2Q", "gelsight_mini"),
        ("usb-GelSight_A-video-index0", "USB Camera", "gelsight"),
        ("usb-Intel_R__RealSense_TM__435-video-index0", "Intel(R) RealSense(TM) Depth Camera 435", "realsense"),
        ("usb-046d_HD_Pro-video-index0", "HD Pro Webcam", "uvc"),
    ],
)
def test_sensors_and_depth_cameras_are_recognised_by_their_names(roots, name, label, driver):
    plug_camera(roots, name, 0, label)
    assert tomllib.loads(discover.find_cameras(*roots)[0].toml)["driver"] == driver


def test_without_stable_names_cameras_are_found_by_number(roots):
    plug_camera(roots, None, 2, "Webcam")
    plug_camera(roots, None, 3, "Webcam", index="1")
    (found,) = discover.find_cameras(*roots)
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
