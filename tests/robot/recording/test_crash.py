"""A failure at any step of writing leaves complete grasps, and the writer can continue."""

import builtins
import contextlib
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from robot.errors import RobotError, StorageError
from robot.recording import folder as module
from robot.recording.folder import RecordingWriter
from robot.recording.grasp import RecordedGrasp
from robot.storage import LineFile
from tests.robot.recording.test_recording import INFO, ids, pictures, two_grasps


class Failing:
    """Counts the disk calls inside a `with` block and raises at one of them."""

    def __init__(self, monkeypatch, error, at=None):
        self.monkeypatch, self.error, self.at, self.count = monkeypatch, error, at, 0

    def __enter__(self):
        for name in ("fsync", "replace", "open"):
            self.monkeypatch.setattr(os, name, self._wrapped(getattr(os, name)))
        self.monkeypatch.setattr(builtins, "open", self._wrapped(builtins.open))
        return self

    def __exit__(self, *_):
        self.monkeypatch.undo()

    def _wrapped(self, function):
        def call(*arguments, **options):
            self.count += 1
            if self.count == self.at:
                raise self.error
            return function(*arguments, **options)

        return call


STEPS = 3 * 3 + 2 + 1
"""Open, fsync, replace of three images; open and fsync of their folder; fsync of the line."""


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["full", "stop"])
def test_a_failure_at_any_step_leaves_a_complete_recording_and_the_writer_continues(tmp_path, monkeypatch, error):
    two_grasps(tmp_path)
    before = (tmp_path / "metadata.jsonl").read_bytes()
    expected = StorageError if isinstance(error, OSError) else KeyboardInterrupt
    with RecordingWriter(tmp_path, INFO) as writer:
        for step in range(1, STEPS + 1):
            with Failing(monkeypatch, error, step), pytest.raises(expected):
                writer.append("3", "cup", pictures(3))
            assert (tmp_path / "metadata.jsonl").read_bytes() == before
            assert not list(tmp_path.rglob("*.part"))
            assert set(writer.grasp_ids) == {"1", "2"}
        with Failing(monkeypatch, None) as steps:
            writer.append("3", "cup", pictures(3))
    assert steps.count == STEPS
    assert ids(tmp_path) == ["1", "2", "3"]


class FullDisk:
    """A raw file that accepts `room` more bytes and then fails."""

    def __init__(self, file, room):
        self.file, self.room = file, room

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        if self.room == 0:
            raise OSError(28, "No space left on device")
        count = self.file.write(data[: self.room])
        self.room -= count
        return count


@pytest.mark.parametrize(("room", "truncates"), [(0, True), (40, True), (40, False)])
def test_a_partially_written_line_is_removed(tmp_path, room, truncates):
    two_grasps(tmp_path)
    with RecordingWriter(tmp_path, INFO) as writer:
        real = writer._lines._file
        writer._lines._file = FullDisk(real, room)
        if not truncates:
            writer._lines._file.truncate = lambda size: (_ for _ in ()).throw(OSError(5, "Input/output error"))
        with pytest.raises(StorageError, match="could not be written: No space left on device"):
            writer.append("3", "cup", pictures())
        assert ids(tmp_path) == ["1", "2"]
        writer._lines._file = real
        writer._lines._file = FullDisk(real, 10**6)
        writer._lines._file.write = lambda data: real.write(data[:7])  # a line is completed piece by piece
        writer.append("3", "cup", pictures())
    assert ids(tmp_path) == ["1", "2", "3"]


def test_the_images_are_on_disk_before_the_line(tmp_path, monkeypatch):
    are_on_disk = []
    append = LineFile.append

    def checked(self, line):
        are_on_disk.append(
            all((tmp_path / path).is_file() for path in RecordedGrasp.from_row(json.loads(line)).images().values())
        )
        append(self, line)

    monkeypatch.setattr(LineFile, "append", checked)
    two_grasps(tmp_path)
    assert are_on_disk == [True, True]


@pytest.mark.parametrize("step", range(1, 7))
def test_a_recording_can_be_created_after_a_failure_at_any_step(tmp_path, monkeypatch, step):
    failing = Failing(monkeypatch, OSError(28, "No space left on device"), step)
    with contextlib.suppress(RobotError), failing:
        RecordingWriter(tmp_path / "r", INFO).close()
    assert failing.count >= step
    with RecordingWriter(tmp_path / "r", INFO) as writer:
        writer.append("1", "mug", pictures())
    assert ids(tmp_path / "r") == ["1"]


def test_a_killed_process_leaves_complete_grasps(tmp_path):
    code = (
        "import os, sys; import numpy as np; from robot.recording import folder as recording\n"
        "writer = recording.RecordingWriter(sys.argv[1], {'source': 'test', 'sensor': 'GelSight'})\n"
        "image = np.zeros((2, 2, 3), np.uint8)\n"
        "writer.append('1', 'mug', {'photo': image, 'touch_a': image})\n"
        "recording.sync = lambda folder: os._exit(9)\n"
        "writer.append('2', 'mug', {'photo': image, 'touch_a': image})\n"
    )
    root = Path(module.__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "r")], check=False, cwd=root)
    assert done.returncode == 9
    assert ids(tmp_path / "r") == ["1"]
    with RecordingWriter(tmp_path / "r", INFO) as writer:  # the lock ended with the process
        writer.append("2", "mug", pictures())
    assert ids(tmp_path / "r") == ["1", "2"]


def test_the_images_of_a_grasp_are_synced_at_the_same_time(tmp_path, monkeypatch):
    started, real = threading.Barrier(3, timeout=10), os.fsync

    def sync(descriptor):
        if threading.current_thread() is not threading.main_thread():
            started.wait()  # breaks if the images are synced one after the other
        real(descriptor)

    monkeypatch.setattr(os, "fsync", sync)
    with RecordingWriter(tmp_path, INFO) as writer:
        writer.append("1", "mug", pictures())
    assert ids(tmp_path) == ["1"]
