"""Fake cameras with the interfaces of OpenCV and pyrealsense2, and with faults to switch on."""

import threading
import time
from types import SimpleNamespace

import cv2
import numpy as np


class FakeVideoDevice:
    """A USB camera that counts its pictures. `open` replaces cv2.VideoCapture and adds to `captures`.

    Faults are the attributes `busy`, `dead`, `frozen` and `damaged` (number of pictures that do not decode).

    Attributes:
        fps: Pictures per second.
        size: (width, height).
        lacks: Settings that it does not have.
        stubborn: Settings that do not change.
    """

    def __init__(self, fps=200.0, size=(8, 6), lacks=(), stubborn=()):
        self.fps, self.size = fps, size
        self.lacks, self.stubborn = set(lacks), set(stubborn)
        self.values = {cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"YUYV")), cv2.CAP_PROP_FPS: 15.0}
        self.busy = self.dead = self.frozen = False
        self.damaged = self.pictures = 0
        self.captures, self.written = [], []

    def open(self, path, backend=None):
        self.captures.append(FakeCapture(self, path, backend))
        return self.captures[-1]

    @property
    def open_captures(self):
        return [capture for capture in self.captures if not capture.released]

    def picture(self, number):
        """Return a BGR picture: blue is the number, red is 200 in the first row and 100 elsewhere."""
        width, height = self.size
        pixels = np.full((height, width, 3), (number % 256, 50, 100), np.uint8)
        pixels[0, :, 2] = 200
        return pixels


class FakeCapture:
    def __init__(self, camera, path, backend):
        self.camera, self.path, self.backend = camera, path, backend
        self.released = False
        self.taken_s = 0.0

    def isOpened(self):
        return not (self.camera.busy or self.camera.dead or self.released)

    def set(self, number, value):
        camera = self.camera
        camera.written.append((number, value))
        if number in camera.lacks or number in camera.stubborn:
            return False
        camera.values[number] = value
        return True

    def get(self, number):
        if number == cv2.CAP_PROP_POS_MSEC:
            return 1000 * self.taken_s
        return -1.0 if number in self.camera.lacks else self.camera.values.get(number, 0.0)

    def grab(self):
        camera = self.camera
        if camera.dead or self.released:
            return False
        time.sleep(1 / camera.fps - time.monotonic() % (1 / camera.fps))
        self.taken_s = time.monotonic()
        return True

    def retrieve(self):
        camera = self.camera
        if camera.damaged > 0:
            camera.damaged -= 1
            return False, None
        camera.pictures += not camera.frozen
        return True, camera.picture(camera.pictures)

    def release(self):
        self.released = True


class FakeRealSense:
    """The module pyrealsense2 with one or more cameras: 4 x 3 pixels, depth scale 0.5 mm."""

    def __init__(self, serials=("123",)):
        self.serials = serials
        self.waiting = 0
        self.started, self.stopped, self.streams = [], 0, []
        self.silent = False
        self.raw = np.array([[0, 1000, 1000, 2000]] * 3, np.uint16)
        self.camera_info = SimpleNamespace(serial_number="serial", name="name")
        self.stream = SimpleNamespace(depth="depth", color="colour")
        self.format = SimpleNamespace(z16="z16", rgb8="rgb8")

    def context(self):
        found = [SimpleNamespace(get_info={"serial": serial, "name": "D435"}.get) for serial in self.serials]
        return SimpleNamespace(query_devices=lambda: found)

    def config(self):
        return SimpleNamespace(enable_device=self.started.append, enable_stream=lambda *args: self.streams.append(args))

    def pipeline(self):
        return SimpleNamespace(
            start=lambda config: self._profile(),
            stop=self._stop,
            wait_for_frames=self._wait,
            poll_for_frames=self._poll,
        )

    def align(self, stream):
        assert stream == "colour"
        return SimpleNamespace(process=lambda frames: frames)

    def _profile(self):
        if self.silent:
            raise RuntimeError("Couldn't resolve requests")
        lens = SimpleNamespace(width=4, height=3, fx=10.0, fy=11.0, ppx=1.5, ppy=1.0, coeffs=[0.0] * 5)
        video = SimpleNamespace(get_intrinsics=lambda: lens, fps=lambda: 30)
        sensor = SimpleNamespace(get_depth_scale=lambda: 0.0005)
        return SimpleNamespace(
            get_stream=lambda stream: SimpleNamespace(as_video_stream_profile=lambda: video),
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
        )

    def _stop(self):
        self.stopped += 1

    def _poll(self):
        self.waiting = 0

    def _wait(self, timeout_ms):
        if self.silent:
            raise RuntimeError(f"Frame didn't arrive within {timeout_ms}")
        colour = np.zeros((3, 4, 3), np.uint8)
        colour[..., 0] = 10 * np.arange(4)  # red grows to the right
        colour[..., 2] = self.waiting  # blue: its age
        colour[..., 1] = 1
        frame, depth = SimpleNamespace(get_data=lambda: colour), SimpleNamespace(get_data=lambda: self.raw)
        return SimpleNamespace(get_color_frame=lambda: frame, get_depth_frame=lambda: depth)


def own_threads():
    """Return the threads that read cameras."""
    return [thread for thread in threading.enumerate() if thread.name.startswith("frames of")]
