"""Cost of reading cameras: frames per second, their age when read, the skew of two fingers, and the work per frame.

Fake cameras deliver frames at a camera's rate; everything between them and the reader is the code that runs on a rig.
"""

import math
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np

from benchmarks.common import ResultLine, duration
from robot.devices import TactileSensor, read_together
from robot.drivers.gels.opencv import OpencvTactile
from robot.drivers.video.rectify import Rectifier, to_rgb
from tests.fake_video import FakeVideoDevice

SIZE = (640, 480)
APART_S = 0.010
QUICK: dict[str, Any] = {"warmup_s": 0.2, "timeout_s": 10.0}


def measure(seconds: float = 3.0) -> Iterator[ResultLine]:
    """Yield a line for each rate, for each way to match two fingers, and for the work on one frame."""
    for fps in (30.0, 60.0):
        yield _rate(fps, seconds)
    yield _skew("newest of each", 1, seconds)
    yield _skew("nearest in time", 4, seconds)
    yield from _work()


class _Rig(ExitStack):
    """Sensors over fake cameras, closed at the end."""

    def __init__(self) -> None:
        super().__init__()
        self._cameras: dict[str, FakeVideoDevice] = {}
        self._folder = Path(self.enter_context(tempfile.TemporaryDirectory())).resolve()
        self.enter_context(mock.patch("cv2.VideoCapture", lambda path, backend: self._cameras[path].open(path)))

    def gel(self, finger: str, camera: FakeVideoDevice, keep: int = 4) -> OpencvTactile:
        """Return a connected sensor over this camera."""
        path = self._folder / f"usb-{finger}"
        path.touch()
        self._cameras[str(path)] = camera
        return self.enter_context(OpencvTactile(finger=finger, device=str(path), keep=keep, **QUICK))


def _rate(fps: float, seconds: float) -> ResultLine:
    """Measure the frames per second that arrive, and the age of the newest at random moments."""
    rng = np.random.default_rng(0)
    ages: list[float] = []
    with _Rig() as rig:
        gel = rig.gel("a", FakeVideoDevice(fps=fps, size=SIZE, stamps=True))
        start, before = time.monotonic(), gel.frame_count
        while time.monotonic() - start < seconds:
            time.sleep(rng.uniform(0.0, 2 / fps))
            ages.append(time.monotonic() - gel.read().time_s)
        rate = (gel.frame_count - before) / (time.monotonic() - start)
    median, q99 = float(np.median(ages)), float(np.quantile(ages, 0.99))
    text = f"{rate:.1f} of {fps:g} frames per second; age when read {duration(median)}, .99 quantile {duration(q99)}"
    figures = {"per_s": rate, "age_s": median, "age_99_s": q99}
    return ResultLine("cameras", f"{SIZE[0]} x {SIZE[1]} at {fps:g}", text, figures)


def _skew(way: str, keep: int, seconds: float) -> ResultLine:
    """Read two cameras of 30 frames per second, 10 ms apart, at random moments."""
    rng = np.random.default_rng(1)
    skews: list[float] = []
    with _Rig() as rig:
        sensors: dict[str, TactileSensor] = {
            finger: rig.gel(finger, FakeVideoDevice(fps=30.0, size=SIZE, phase_s=phase, stamps=True), keep)
            for finger, phase in (("a", 0.0), ("b", APART_S))
        }
        start = time.monotonic()
        while time.monotonic() - start < seconds:
            time.sleep(rng.uniform(0.0, 0.06))
            skews.append(read_together(sensors)[1])
    mean, largest = float(np.mean(skews)), float(np.max(skews))
    text = f"two fingers 10 ms out of step: mean difference {duration(mean)}, at most {duration(largest)}"
    return ResultLine("cameras", f"skew, {way}", text, {"mean_s": mean, "most_s": largest})


def _work() -> Iterator[ResultLine]:
    """Measure the processing of one frame on one thread."""
    picture = np.random.default_rng(3).integers(0, 255, (960, 1280, 3), np.uint8)
    corners = ((100.0, 80.0), (1180.0, 95.0), (1170.0, 900.0), (120.0, 890.0))
    rectifiers = {
        "crop": Rectifier(crop=(0.15,) * 4),
        "crop to 640 x 480": Rectifier(crop=(0.15,) * 4, output_px=(640, 480)),
        "four corners to 640 x 480": Rectifier(corners_px=corners, image_px=(1280, 960), output_px=(640, 480)),
    }
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for name, rectifier in rectifiers.items():
            seconds = _seconds(rectifier, picture)
            yield ResultLine("cameras", f"1280 x 960, {name}", f"{duration(seconds)} per frame", {"seconds": seconds})
    finally:
        cv2.setNumThreads(threads)


def _seconds(rectifier: Rectifier, picture: np.ndarray) -> float:
    """Return the least of ten times; the rest is noise of the machine."""
    best = math.inf
    for _ in range(10):
        start = time.perf_counter()
        to_rgb(rectifier.apply(picture))
        best = min(best, time.perf_counter() - start)
    return best


if __name__ == "__main__":
    for line in measure():
        print(line)
