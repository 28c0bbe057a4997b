"""The thread that reads a camera, with scripted streams."""

import queue
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from robot.devices import read_together
from robot.drivers.usb_camera import stream as frames
from robot.drivers.usb_camera.stream import FrameReader, UsbCameraSettings
from robot.errors import DeviceError
from robot.readings import Frame
from tests.fake_video import own_threads
from tests.waiting import wait_until

SETTINGS = UsbCameraSettings(device="eye", warmup_s=0.0, timeout_s=5.0, frozen_s=2.0)
ENOUGH_S = 10.0


class Script:
    """A camera whose streams return the queued frames in order; a queued exception is raised."""

    def __init__(self):
        self.items, self.opened, self.closed, self.asked = queue.Queue(), 0, 0, 0
        self.unopenable = 0
        self.number = 0

    def open(self):
        if self.unopenable:
            self.unopenable -= 1
            raise OSError(16, "Device or resource busy")
        self.opened += 1
        return self

    def next(self):
        self.asked += 1
        item = self.items.get(timeout=ENOUGH_S)
        if isinstance(item, Exception):
            raise item
        return item

    def close(self):
        self.closed += 1

    def show(self, *times, picture=None):
        """Queue frames taken at these times, each with new pixels unless `picture` is given."""
        for time_s in times:
            self.number += 1
            self.items.put(Frame(np.full((40, 40, 3), self.number if picture is None else picture, np.uint8), time_s))


@pytest.fixture
def script():
    return Script()


@pytest.fixture
def make(script, monkeypatch):
    """Return a maker of readers, which are closed at the end of the test without leftover threads."""
    made = []

    def reader(settings=SETTINGS, script=script, backoff_s=(1e-3, 4e-3)):
        monkeypatch.setattr(frames, "BACKOFF_S", backoff_s)
        made.append((script, FrameReader("eye", script.open, settings, clock=lambda: 0.0)))
        return made[-1][1]

    yield reader
    for own, each in made:
        own.items.put(RuntimeError("the test is over"))
        each.close()
    assert not own_threads()


def wait_for_frames(script, count):
    """Wait until the reader has stored this many frames: it asks for the next one."""
    wait_until(lambda: script.asked > count)


def test_the_newest_frame_is_returned_and_the_newest_few_are_buffered(script, make):
    script.show(1.0)
    reader = make()
    reader.start()
    assert reader.newest().time_s == 1.0
    script.show(2.0, 3.0, 4.0, 5.0, 6.0)
    wait_for_frames(script, 6)
    assert reader.newest().time_s == 6.0
    assert [reader.near(time_s).time_s for time_s in (0.0, 3.2, 4.4, 4.6, 99.0)] == [3.0, 3.0, 4.0, 5.0, 6.0]


@pytest.mark.parametrize("error", [DeviceError("it ended"), OSError(19, "No such device"), KeyError()])
def test_a_lost_stream_is_closed_opened_again_and_counted_and_its_old_frames_are_dropped(script, make, error):
    script.show(1.0)
    reader = make()
    reader.start()
    script.items.put(error)
    wait_until(lambda: script.opened == 2)
    script.show(7.0)
    assert reader.newest().time_s == 7.0
    assert reader.near(1.0).time_s == 7.0
    assert (reader.lost_count, script.closed) == (1, 1)


def test_the_waits_before_reopening_double_up_to_a_limit_and_a_frame_resets_them(script, make, monkeypatch):
    script.show(1.0)
    reader = make()
    waits = []
    monkeypatch.setattr(reader._reopen, "wait", waits.append)
    reader.start()
    script.unopenable = 4
    script.items.put(DeviceError("gone"))
    wait_until(lambda: script.opened == 2)
    script.show(2.0)
    wait_for_frames(script, 3)  # the loss counts too
    script.items.put(DeviceError("gone again"))
    wait_until(lambda: script.opened == 3)
    assert waits == [0.001, 0.002, 0.004, 0.004, 0.004, 0.001]


def test_a_wait_ends_after_its_timeout_with_the_reason_and_a_lost_stream_is_reopened_on_request(script, make):
    with pytest.raises(DeviceError, match=r"no picture within 0\.001 s: no frame arrived"):
        make(UsbCameraSettings(device="eye", warmup_s=0.0, timeout_s=1e-3), script=Script()).start()
    script.show(1.0)
    reader = make(UsbCameraSettings(device="eye", warmup_s=0.0, timeout_s=600.0), backoff_s=(100.0, 100.0))
    reader.start()
    assert reader.after(0.5, 0.0).time_s == 1.0
    with pytest.raises(DeviceError, match="no picture within 0 s"):
        reader.after(1.0, 0.0)
    script.items.put(OSError(19, "No such device"))
    wait_until(lambda: reader.lost_count == 1)
    with pytest.raises(DeviceError, match=r"within 0\.01 s: .*No such device"):
        reader.after(0.5, 0.01)
    script.show(2.0)
    reader.recover()
    assert reader.newest().time_s == 2.0


def test_a_frame_equal_to_the_last_is_as_old_as_its_first_copy(script, make):
    reader = make()
    script.show(0.0)
    script.show(0.1, 0.6, 1.1, picture=7)
    reader.start()
    wait_for_frames(script, 4)
    assert reader.newest().time_s == reader.near(1.1).time_s == 0.1
    assert reader.near(0.0).time_s == 0.0  # and removes no older one
    script.show(1.2, picture=8)
    assert reader.after(0.1, ENOUGH_S).time_s == 1.2


def test_a_lost_stream_warms_up_again(script, make):
    reader = make(UsbCameraSettings(device="eye", warmup_s=30.0, timeout_s=1e-3))
    script.show(31.0)
    reader.start()
    script.items.put(OSError(19, "No such device"))
    wait_until(lambda: reader.lost_count == 1)
    later = threading.Timer(0.2, script.show, (32.0,))
    later.start()
    reader.recover()
    assert reader.newest().time_s == 32.0
    later.join()


def test_closing_raises_if_the_driver_blocks_and_the_camera_is_closed_later(script, make, monkeypatch):
    monkeypatch.setattr(frames, "_CLOSING_S", 0.02)
    script.show(1.0)
    reader = make()
    reader.start()
    with pytest.raises(DeviceError, match="its driver still waits"):
        reader.close()
    script.show(2.0)
    wait_until(lambda: script.closed == 1)


def test_two_fingers_out_of_phase_are_matched_closer_in_time_than_their_newest_frames():
    """At 30 frames/s with a phase of 10 ms, the newest frames are 24 ms apart and the best match 10 ms."""

    def sensor(*times):
        buffered = [Frame(np.zeros((1, 1, 3), np.uint8), time_s) for time_s in times]
        nearest = lambda near_s: min(buffered, key=lambda frame: abs(frame.time_s - near_s))  # noqa: E731
        return SimpleNamespace(read=lambda _, near_s=9.0: nearest(near_s))

    found, skew = read_together({"a": sensor(0.0, 0.033, 0.067), "b": sensor(0.010, 0.043)})
    assert skew == pytest.approx(0.010)
    assert [found[finger].time_s for finger in "ab"] == [0.033, 0.043]
