"""Videos, image folders and recordings as devices."""

import json
import math
import os

import cv2
import numpy as np
import pytest

from robot.drivers.replay import ImageFolderSensor, ReplayCamera, VideoSensor
from robot.errors import DeviceError, RobotConfigError
from robot.grasping.attempt import depth_in_mm
from robot.recording.folder import RecordingWriter
from tests.fake_video import EXTRINSICS

LEVELS = (20, 60, 100, 140, 180, 220)
LENS = {"fx": 10.0, "fy": 11.0, "cx": 3.5, "cy": 2.5}


class Clock:
    def __init__(self):
        self.now_s = 50.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def video(tmp_path):
    """Six grey pictures at 10 frames/s."""
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for level in LEVELS:
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    return path


@pytest.fixture
def folder(tmp_path):
    """Six pictures with blue 255, and a file that is not a picture."""
    path = tmp_path / "pictures"
    path.mkdir()
    for number, level in enumerate(LEVELS):
        cv2.imwrite(str(path / f"{number}.png"), np.full((48, 64, 3), (255, level, level), np.uint8))
    (path / "notes.txt").write_text("taken by hand")
    return path


def level(frame):
    """Return the nearest grey level; videos are not exact."""
    return min(LEVELS, key=lambda each: abs(each - float(frame.pixels[..., 1].mean())))


@pytest.fixture(params=["video", "folder"])
def make(request, video, folder, clock):
    """Return a maker of sensors of the same six pictures, from a video or a folder."""
    kind, path = {"video": (VideoSensor, video), "folder": (ImageFolderSensor, folder)}[request.param]
    return lambda **more: kind(finger="a", path=str(path), fps=10.0, clock=clock, **more)


def test_each_picture_is_shown_at_its_time(make, clock):
    with make() as gel:
        for later, expected, taken in ((0.0, 20, 0.0), (0.05, 20, 0.0), (0.15, 60, 0.1), (0.5625, 220, 0.5)):
            clock.now_s = 50.0 + later
            frame = gel.read()
            assert level(frame) == expected
            assert frame.time_s == pytest.approx(50.0 + taken)


def test_the_first_picture_follows_the_last(make, clock):
    with make() as gel:
        for later, expected in ((0.65, 20), (0.95, 140), (60.05, 20), (60.15, 60)):
            clock.now_s = 50.0 + later
            frame = gel.read()
            assert level(frame) == expected
            assert 0 <= clock.now_s - frame.time_s < 0.1 + 1e-9


def test_the_end_is_an_error_without_loop(make, clock):
    with make(loop=False) as gel:
        clock.now_s += 0.55
        assert level(gel.read()) == 220
        clock.now_s += 0.1
        with pytest.raises(DeviceError, match=r"its 6 pictures lasted 0\.6 s; set loop = true"):
            gel.read()


def test_the_picture_nearest_to_a_time_is_never_one_of_the_future(make, clock):
    with make() as gel:
        clock.now_s = 50.35
        assert [level(gel.read(10, near_s=50.0 + near)) for near in (0.0, 0.12, 0.19, 9.0, -9.0)] == [
            20,
            60,
            100,
            140,
            20,
        ]


@pytest.mark.parametrize("fps", [1.0, 0.5])
def test_pictures_of_a_slow_sensor_are_never_stale(folder, clock, fps):
    """At 0.5 frames/s each picture is shown twenty times, every tenth of a second."""
    with ImageFolderSensor(finger="a", path=str(folder), fps=fps, clock=clock) as gel:
        for later, expected in ((0.0, 20), (0.99, 20), (1.05, 60), (1.95, 60), (5.51, 220), (6.05, 20)):
            clock.now_s = 50.0 + later / fps
            frame = gel.read(0.11)
            assert level(frame) == expected
        assert level(gel.read(99.0, near_s=50.0 + 1.5 / fps)) == 60


def test_a_slow_video_without_loop_ends_after_its_last_picture(folder, clock):
    with ImageFolderSensor(finger="a", path=str(folder), fps=2.0, loop=False, clock=clock) as gel:
        clock.now_s += 2.95
        assert level(gel.read()) == 220
        clock.now_s += 0.1
        with pytest.raises(DeviceError, match=r"its 6 pictures lasted 3 s"):
            gel.read()


def test_a_missing_calibration_file_is_named_before_connecting(make, tmp_path):
    with pytest.raises(RobotConfigError, match=r"none\.json cannot be read"):
        make(calibration=str(tmp_path / "none.json"))


def test_connecting_again_starts_at_the_first_picture(make, clock):
    gel = make()
    for _ in range(2):
        with gel:
            assert level(gel.read()) == 20
            clock.now_s += 0.25
            assert level(gel.read()) == 100
    gel.close()


def test_two_sensors_of_one_clock_show_the_same_moment(make, clock):
    with make() as one, make() as other:
        clock.now_s += 0.45
        assert one.read().time_s == other.read().time_s


def test_pictures_are_cropped_and_resized_like_those_of_a_camera(make):
    with make(crop=[0.5, 0.0, 0.0, 0.0], output_px=[16, 12]) as gel:
        assert gel.read(10).pixels.shape == (12, 16, 3)
    with pytest.raises(RobotConfigError, match="crop"):
        make(crop=[2.0])


def test_the_settings_describe_the_replay(make):
    with make() as gel:
        found = json.loads(json.dumps(gel.settings(), allow_nan=False))
    assert (found["pictures"], found["fps"], found["loop"]) == (6, 10.0, True)


def test_pictures_are_in_rgb(folder, clock):
    with ImageFolderSensor(finger="a", path=str(folder), clock=clock) as gel:
        assert gel.read().pixels[0, 0].tolist() == [20, 20, 255]


def test_a_video_has_its_own_rate_by_default(video, clock):
    with VideoSensor(finger="a", path=str(video), clock=clock) as gel:
        assert gel.settings()["fps"] == pytest.approx(10.0)


def test_a_video_is_decoded_forward_and_opened_again_to_go_back(video, clock, monkeypatch):
    opened = []
    real = cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", lambda path: opened.append(path) or real(path))
    with VideoSensor(finger="a", path=str(video), clock=clock) as gel:
        monkeypatch.setattr("robot.drivers.replay._CACHE_SIZE", 1)
        for later in (0.0, 0.15, 0.15, 0.45):
            clock.now_s = 50.0 + later
            gel.read()
        assert len(opened) == 1
        clock.now_s = 50.75
        assert level(gel.read()) == 60
        assert len(opened) == 2


def test_a_video_shorter_than_its_header_is_an_error(video, clock):
    with VideoSensor(finger="a", path=str(video), clock=clock) as gel:
        gel._count = 10
        clock.now_s += 0.85
        with pytest.raises(DeviceError, match="must have 10 pictures, but ends after 6"):
            gel.read()


@pytest.mark.parametrize("kind", [VideoSensor, ImageFolderSensor])
def test_a_source_without_pictures_cannot_be_connected(kind, tmp_path, clock):
    empty = tmp_path / "empty"
    empty.mkdir() if kind is ImageFolderSensor else empty.write_text("no video")
    for path in (empty, tmp_path / "none"):
        with pytest.raises(DeviceError):
            kind(finger="a", path=str(path), clock=clock).connect()


def test_a_picture_that_cannot_be_decoded_is_named(folder, clock):
    (folder / "0.png").write_bytes(b"not a picture")
    with pytest.raises(DeviceError, match=r"0\.png must be a picture"):
        ImageFolderSensor(finger="a", path=str(folder), clock=clock).connect()


def test_hidden_files_are_not_pictures(folder, pairs, clock):
    """macOS writes such a file next to each picture that it copies."""
    for hidden in (folder / "._0.png", pairs / "._view1.png"):
        hidden.write_bytes(b"Mac OS X")
    with ImageFolderSensor(finger="a", path=str(folder), clock=clock) as gel:
        assert gel.settings()["pictures"] == len(LEVELS)
    with camera(pairs) as eye:
        assert int(eye.read().colour[0, 0, 1]) == 1


def test_a_pipe_with_a_pictures_name_is_refused_unread(folder, clock):
    """Reading it would wait for ever for a writer."""
    (folder / "0.png").unlink()
    os.mkfifo(folder / "0.png")
    with pytest.raises(DeviceError, match=r"0\.png must be a picture, but is not a file"):
        ImageFolderSensor(finger="a", path=str(folder), clock=clock).connect()


@pytest.mark.parametrize("fps", [-1.0, float("nan"), 2000.0, 1e-3, 5e-324, float("inf")])
def test_a_rate_out_of_range_is_refused(fps):
    with pytest.raises(RobotConfigError, match="fps"):
        VideoSensor(finger="a", path="video.avi", fps=fps)


# The camera -------------------------------------------------------------------------------------------------

DEPTH_MM = np.array([[0, 900, 1500, 65535]] * 3, np.uint16)


def colour(number):
    """Return a picture in RGB."""
    return np.full((3, 4, 3), (200, number, 0), np.uint8)


@pytest.fixture
def pairs(tmp_path):
    """Two pictures with depth, and intrinsics."""
    path = tmp_path / "scene"
    path.mkdir()
    for number in (1, 2):
        cv2.imwrite(str(path / f"view{number}.png"), colour(number)[..., ::-1])
        cv2.imwrite(str(path / f"view{number}_depth.png"), number * (DEPTH_MM // 2))
    (path / "intrinsics.json").write_text(json.dumps(LENS))
    return path


@pytest.fixture
def recording(tmp_path):
    """Two grasps of a recording; pixels of the second are brighter."""
    path = tmp_path / "recording"
    depth = depth_in_mm(np.array([[np.nan, 0.9, 1.5, 0.4]] * 3, np.float32))
    with RecordingWriter(path, {"source": "test", "sensor": "gel"}) as writer:
        for number in (1, 2):
            images = {"photo": colour(number), "depth": depth, "touch_a": colour(0)}
            writer.append(f"g{number}", "mug", images)
    return path


def camera(path, **more):
    return ReplayCamera(path=str(path), extrinsics=EXTRINSICS, **more)


def test_each_read_returns_the_next_picture_and_the_first_after_the_last(pairs):
    with camera(pairs) as eye:
        assert [int(eye.read().colour[0, 0, 1]) for _ in range(3)] == [1, 2, 1]
        eye.seek(3)
        assert int(eye.read().colour[0, 0, 1]) == 2


def test_depth_is_in_metres_and_nan_where_unknown(pairs):
    with camera(pairs) as eye:
        image = eye.read()
    np.testing.assert_allclose(image.depth_m[0], [np.nan, 0.45, 0.75, 32.767], rtol=1e-6)
    assert image.colour[0, 0].tolist() == [200, 1, 0]
    assert (image.intrinsics.fx, image.intrinsics.cy) == (10.0, 2.5)


def test_without_depth_no_depth_is_read(pairs):
    (pairs / "view1_depth.png").write_bytes(b"damaged")
    with camera(pairs) as eye:
        assert eye.read(depth=False).depth_m is None
        eye.seek(0)
        with pytest.raises(DeviceError, match=r"view1_depth\.png must be a picture"):
            eye.read()


def test_a_folder_with_a_missing_depth_is_a_camera_without_depth(pairs):
    (pairs / "view2_depth.png").unlink()
    (pairs / "intrinsics.json").unlink()
    with camera(pairs) as eye:
        assert not eye.has_depth
        assert eye.read(depth=False).depth_m is None
        with pytest.raises(DeviceError, match="has no depth: read it with depth=False"):
            eye.read()


def test_depth_without_intrinsics_cannot_be_connected(recording):
    with pytest.raises(DeviceError, match="contains depth: give fx, fy, cx and cy"):
        camera(recording).connect()


def test_the_cameras_of_a_recording_are_replayed_with_intrinsics_from_the_rigs_file(recording):
    with camera(recording, **LENS) as eye:
        first, second = eye.read(), eye.read()
    assert [int(image.colour[0, 0, 1]) for image in (first, second)] == [1, 2]
    np.testing.assert_allclose(first.depth_m[0], [np.nan, 0.9, 1.5, 0.4], rtol=1e-6)
    assert first.intrinsics.fy == 11.0


@pytest.mark.parametrize(
    "lens",
    [
        {"fx": 10.0},
        {"fx": -500.0},
        {"fx": 0.0},
        {"cx": 3.0, "cy": 3.0},
        LENS | {"fx": -500.0},
        LENS | {"fy": 1e9},
        LENS | {"cx": math.inf},
        LENS | {"cy": math.nan},
    ],
)
def test_incomplete_or_invalid_intrinsics_are_refused(pairs, lens):
    with pytest.raises(RobotConfigError, match="fx, fy, cx and cy must be given together"):
        camera(pairs, **lens)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"fx": 1}',
        '{"fx": 1, "fy": 1, "cx": "0", "cy": 0}',
        '{"fx": NaN}',
        json.dumps(LENS | {"fx": -500.0}),
        json.dumps(LENS | {"cy": 10**400}),
    ],
)
def test_an_invalid_intrinsics_file_is_refused_by_its_name(pairs, text):
    (pairs / "intrinsics.json").write_text(text)
    with pytest.raises(DeviceError, match=r"intrinsics\.json.* must"):
        camera(pairs).connect()


def test_depth_that_is_not_16_bit_is_refused(pairs):
    cv2.imwrite(str(pairs / "view1_depth.png"), np.zeros((3, 4), np.uint8))
    with camera(pairs) as eye, pytest.raises(DeviceError, match="must be 16-bit grey"):
        eye.read()


def test_folders_without_pictures_cannot_be_connected(tmp_path):
    with pytest.raises(DeviceError, match="must contain pictures"):
        camera(tmp_path).connect()
    with pytest.raises(DeviceError, match="cannot be connected"):
        camera(tmp_path / "none").connect()
