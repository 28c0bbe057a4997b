"""The thread that reads a camera, over streams whose every picture the test hands out."""

import math
import queue
import threading

import numpy as np
import pytest

from robot.devices import TactileSensor, read_together
from robot.drivers.video import frames
from robot.drivers.video.frames import FrameReader, ReaderSettings
from robot.errors import DeviceError, RobotConfigError
from robot.readings import Frame
from tests.fake_video import own_threads
from tests.waiting import wait_until

SETTINGS = ReaderSettings(warmup_s=0.0, timeout_s=5.0, frozen_s=2.0)
ENOUGH_S = 10.0


class Script:
    """A camera whose streams give what is put in, in that order; an exception is raised. `end` lets every stream go."""

    def __init__(self):
        self.items, self.opened, self.closed = queue.Queue(), 0, 0
        self.unopenable = 0
        self.number = 0

    def open(self):
        if self.unopenable:
            self.unopenable -= 1
            raise OSError(16, "Device or resource busy")
        self.opened += 1
        return self

    def next(self):
        item = self.items.get(timeout=ENOUGH_S)
        if isinstance(item, Exception):
            raise item
        return item

    def close(self):
        self.closed += 1

    def show(self, *times, picture=None):
        """Pictures taken at these times, each new unless `picture` is given."""
        for time_s in times:
            self.number += 1
            self.items.put(Frame(np.full((40, 40, 3), self.number if picture is None else picture, np.uint8), time_s))


@pytest.fixture
def script():
    return Script()


@pytest.fixture
def make(script):
    """Readers of the script, closed at the end of the test; no thread may be left."""
    made = []

    def reader(settings=SETTINGS, script=script, backoff_s=(1e-3, 4e-3)):
        made.append((script, FrameReader("eye", script.open, settings, clock=lambda: 0.0, backoff_s=backoff_s)))
        return made[-1][1]

    yield reader
    for own, each in made:
        own.items.put(RuntimeError("the test is over"))
        each.close()
    assert not own_threads()


def seen(reader, count):
    wait_until(lambda: reader.frame_count >= count)


def test_the_newest_picture_is_given_and_the_newest_few_are_kept(script, make):
    script.show(1.0)
    reader = make()
    reader.start()
    assert reader.newest().time_s == 1.0
    script.show(2.0, 3.0, 4.0, 5.0, 6.0)
    seen(reader, 6)
    assert reader.newest().time_s == 6.0
    assert [reader.near(time_s).time_s for time_s in (0.0, 3.2, 4.4, 4.6, 99.0)] == [3.0, 3.0, 4.0, 5.0, 6.0]


def test_of_two_pictures_equally_near_the_newer_is_given(script, make):
    script.show(1.0, 2.0)
    reader = make()
    reader.start()
    seen(reader, 2)
    assert reader.near(1.5).time_s == 2.0


def test_pictures_of_the_warm_up_are_dropped(script, make):
    script.show(0.1, 0.9, 1.0)
    reader = make(ReaderSettings(warmup_s=1.0, timeout_s=5.0))
    reader.start()
    assert reader.near(0.0).time_s == 1.0
    assert reader.frame_count == 3


def test_a_camera_that_gives_nothing_is_waited_for_and_then_named(script, make):
    reader = make(ReaderSettings(warmup_s=0.0, timeout_s=0.02))
    with pytest.raises(DeviceError, match=r"eye must give a picture within 0\.02 s: nothing came"):
        reader.start()


def test_a_camera_that_cannot_be_opened_leaves_no_thread(script, make):
    script.unopenable = 1
    with pytest.raises(OSError, match="busy"):
        make().start()
    assert not own_threads()


@pytest.mark.parametrize("error", [DeviceError("it gives no more pictures"), OSError(19, "No such device"), KeyError()])
def test_a_lost_stream_is_closed_opened_again_and_counted_and_its_old_pictures_are_not_given(script, make, error):
    script.show(1.0)
    reader = make()
    reader.start()
    script.items.put(error)
    wait_until(lambda: script.opened == 2)
    script.show(7.0)
    assert reader.newest().time_s == 7.0
    assert reader.near(1.0).time_s == 7.0
    assert (reader.lost_count, script.closed) == (1, 1)


def test_what_is_wrong_with_a_lost_stream_is_said_to_whoever_asks(script, make):
    script.show(1.0)
    reader = make(ReaderSettings(warmup_s=0.0, timeout_s=0.02), backoff_s=(ENOUGH_S, ENOUGH_S))
    reader.start()
    script.items.put(DeviceError("it gives no more pictures"))
    wait_until(lambda: reader.lost_count)
    with pytest.raises(DeviceError, match=r"it gives no more pictures; it was lost 1 time\(s\). Is it plugged in"):
        reader.newest()
    with pytest.raises(DeviceError, match="it gives no more pictures"):
        reader.near(1.0)


def test_each_wait_before_opening_again_is_longer_up_to_a_bound_and_a_picture_makes_it_short(script, make, monkeypatch):
    script.show(1.0)
    reader = make()
    waits = []
    monkeypatch.setattr(reader._reopen, "wait", waits.append)
    reader.start()
    script.unopenable = 4
    script.items.put(DeviceError("gone"))
    wait_until(lambda: script.opened == 2)
    script.show(2.0)
    seen(reader, 2)
    script.items.put(DeviceError("gone again"))
    wait_until(lambda: script.opened == 3)
    assert waits == [0.001, 0.002, 0.004, 0.004, 0.004, 0.001]


def test_a_lost_stream_is_opened_at_once_when_somebody_is_in_a_hurry(script, make):
    script.show(1.0)
    reader = make(ReaderSettings(warmup_s=0.0, timeout_s=5.0), backoff_s=(100.0, 100.0))
    reader.start()
    script.items.put(DeviceError("gone"))
    wait_until(lambda: reader.lost_count)
    script.show(2.0)
    reader.reopen_now()
    assert reader.newest().time_s == 2.0


def test_a_newer_picture_can_be_waited_for(script, make):
    script.show(1.0)
    reader = make()
    reader.start()
    threading.Timer(0.05, script.show, args=(2.0,)).start()
    assert reader.after(1.0).time_s == 2.0


def test_a_picture_that_repeats_the_last_is_as_old_as_its_first_copy(script, make):
    reader = make()
    script.show(0.0)
    script.show(0.1, 0.6, 1.1, picture=7)
    reader.start()
    seen(reader, 4)
    assert reader.newest().time_s == reader.near(1.1).time_s == 0.1
    assert reader.near(0.0).time_s == 0.0  # and pushes no older one out
    script.show(1.2, picture=8)
    assert reader.after(0.1).time_s == 1.2


def test_a_stream_that_was_lost_has_time_to_warm_up_again(script, make):
    reader = make(ReaderSettings(warmup_s=30.0, timeout_s=1e-3))
    script.show(31.0)
    reader.start()
    script.items.put(OSError(19, "No such device"))
    wait_until(lambda: reader.lost_count == 1)
    later = threading.Timer(0.2, script.show, (32.0,))
    later.start()
    assert reader.after(31.0).time_s == 32.0
    later.join()


def test_a_stream_that_stands_still_gives_nothing_fresh_long_before_it_counts_as_frozen(script, make):
    script.show(0.0, 0.3, 0.7, picture=7)
    now = [0.7]
    gel = Gel("a", make(), clock=lambda: now[0])
    gel.connect()
    seen(gel.reader, 3)
    with pytest.raises(DeviceError, match=r"at most 0\.5 s old, it is 0\.7 s; is the stream frozen"):
        gel.read()
    assert gel.reader.lost_count == 0


def test_a_stream_frozen_for_long_is_lost_and_said_to_be_frozen(script, make):
    reader = make(ReaderSettings(warmup_s=0.0, timeout_s=0.05, frozen_s=2.0), backoff_s=(ENOUGH_S, ENOUGH_S))
    script.show(0.0, 1.0, 2.0, picture=7)
    reader.start()
    seen(reader, 3)
    assert reader.lost_count == 0
    script.show(2.1, picture=7)
    wait_until(lambda: reader.lost_count)
    with pytest.raises(DeviceError, match=r"frozen: the same picture for 2\.1 s"):
        reader.newest()


def test_a_frozen_stream_stays_frozen_when_it_is_opened_again_until_its_picture_changes(script, make):
    script.show(0.0, picture=7)
    reader = make()
    reader.start()
    script.show(3.0, picture=7)
    wait_until(lambda: script.opened == 2)
    script.show(3.1, picture=7)
    wait_until(lambda: script.opened == 3)
    script.show(3.2, picture=8)
    assert reader.newest().time_s == 3.2
    assert reader.lost_count == 2


def test_pictures_that_differ_in_one_pixel_are_not_frozen(script, make):
    reader = make()
    for number in range(5):
        pixels = np.zeros((40, 40, 3), np.uint8)
        pixels[17, 5, 1] = number  # none of the rows and columns that are compared first
        script.items.put(Frame(pixels, 1.0 * number))
    reader.start()
    seen(reader, 5)
    assert reader.lost_count == 0


def test_closing_ends_the_thread_and_lets_go_of_the_camera_also_twice_and_before_starting(script, make):
    make().close()
    script.show(1.0)
    reader = make()
    reader.start()
    assert len(own_threads()) == 1
    threading.Timer(0.02, script.show, args=(2.0,)).start()
    reader.close()
    reader.close()
    assert not own_threads()
    assert script.closed == script.opened == 1


def test_closing_ends_a_thread_that_waits_to_open_its_camera_again(script, make):
    script.show(1.0)
    reader = make(ReaderSettings(warmup_s=0.0), backoff_s=(100.0, 100.0))
    reader.start()
    script.items.put(DeviceError("gone"))
    wait_until(lambda: reader.lost_count)
    reader.close()
    assert not own_threads()


def test_closing_says_so_when_a_driver_does_not_come_back_and_the_camera_is_let_go_later(script, make, monkeypatch):
    monkeypatch.setattr(frames, "_CLOSING_S", 0.02)
    script.show(1.0)
    reader = make()
    reader.start()
    with pytest.raises(DeviceError, match="its driver still waits"):
        reader.close()
    script.show(2.0)
    wait_until(lambda: script.closed == 1)


@pytest.mark.parametrize(
    "setting",
    [
        {"keep": 0},
        {"warmup_s": -1.0},
        {"warmup_s": math.inf},
        {"timeout_s": 0.0},
        {"timeout_s": math.inf},
        {"timeout_s": 1e10},
        {"frozen_s": math.nan},
        {"frozen_s": 601.0},
    ],
)
def test_settings_out_of_range_are_refused(setting):
    with pytest.raises(RobotConfigError, match=next(iter(setting))):
        ReaderSettings(**setting)


class Gel(TactileSensor):
    """A sensor over a reader."""

    def __init__(self, finger, reader, clock=lambda: 0.1):
        super().__init__(f"gel {finger}", finger, clock=clock)
        self.reader = reader

    def _connect(self):
        self.reader.start()

    def _close(self):
        self.reader.close()

    def _read(self):
        return self.reader.newest()

    def _read_near(self, time_s):
        return self.reader.near(time_s)


def connected(finger, times, make):
    script = Script()
    script.show(*times)
    gel = Gel(finger, make(script=script))
    gel.connect()
    seen(gel.reader, len(times))
    return gel


def test_two_fingers_out_of_step_are_matched_nearer_in_time_than_their_newest_pictures_are(make):
    """At 30 pictures a second and 10 ms apart: the newest are 23 ms apart, the best match 10 ms."""
    a, b = (connected(finger, times, make) for finger, times in (("a", (0.0, 0.033, 0.067)), ("b", (0.010, 0.043))))
    apart = abs(a.read().time_s - b.read().time_s)
    together, skew = read_together({"a": a, "b": b})
    assert apart == pytest.approx(0.024)
    assert skew == pytest.approx(0.010)
    assert [together[finger].time_s for finger in "ab"] == [0.033, 0.043]
