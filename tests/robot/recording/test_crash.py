"""What a recording holds after a failure at any step of writing it: whole grasps, and the writer goes on."""

import builtins
import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from robot.errors import RobotError, StorageError
from robot.recording import folder as module
from robot.recording.folder import RecordedGrasp, RecordingWriter
from tests.robot.recording.test_recording import INFO, ids, pictures, two_grasps


class Failing:
    """Counts the calls that touch the disk and raises at one of them, for the whole of a `with`."""

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


STEPS = 3 * 3 + 2 + 1  # open, fsync, replace of three images; open and fsync of their folder; fsync of the line


def test_the_steps_of_an_append_are_all_tried_below(tmp_path, monkeypatch):
    with RecordingWriter(tmp_path, INFO) as writer, Failing(monkeypatch, None) as steps:
        writer.append("1", "mug", pictures())
    assert steps.count == STEPS


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["full", "stop"])
@pytest.mark.parametrize("step", range(1, STEPS + 1))
def test_a_failure_at_any_step_leaves_a_whole_recording_and_the_writer_goes_on(tmp_path, monkeypatch, step, error):
    two_grasps(tmp_path)
    before = (tmp_path / "metadata.jsonl").read_bytes()
    with RecordingWriter(tmp_path, INFO) as writer:
        expected = StorageError if isinstance(error, OSError) else KeyboardInterrupt
        with Failing(monkeypatch, error, step), pytest.raises(expected):
            writer.append("3", "cup", pictures(3))
        assert (tmp_path / "metadata.jsonl").read_bytes() == before
        assert not list(tmp_path.rglob("*.part"))
        assert set(writer.grasp_ids) == {"1", "2"}
        writer.append("3", "cup", pictures(3))
    assert ids(tmp_path) == ["1", "2", "3"]


class FullDisk:
    """A raw file that takes `room` more bytes and then fails."""

    def __init__(self, file, room):
        self.file, self.room = file, room

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        if self.room == 0:
            raise OSError(28, "No space left on device")
        taken = self.file.write(data[: self.room])
        self.room -= taken
        return taken


@pytest.mark.parametrize("room", [0, 1, 40])
@pytest.mark.parametrize("truncates", [True, False])
def test_a_line_that_fits_in_half_leaves_no_half(tmp_path, room, truncates):
    two_grasps(tmp_path)
    with RecordingWriter(tmp_path, INFO) as writer:
        whole = writer._file
        writer._file = FullDisk(whole, room)
        if not truncates:
            writer._file.truncate = lambda size: (_ for _ in ()).throw(OSError(5, "Input/output error"))
        with pytest.raises(StorageError, match="could not be written: No space left on device"):
            writer.append("3", "cup", pictures())
        assert ids(tmp_path) == ["1", "2"]
        writer._file = whole
        writer.append("3", "cup", pictures())
    assert ids(tmp_path) == ["1", "2", "3"]


def test_a_line_written_in_pieces_is_whole(tmp_path):
    with RecordingWriter(tmp_path, INFO) as writer:
        whole = writer._file
        writer._file = FullDisk(whole, 10**6)
        writer._file.write = lambda data: whole.write(data[:7])
        writer.append("1", "mug", pictures())
    assert ids(tmp_path) == ["1"]


def test_the_images_are_on_disk_before_the_line(tmp_path, monkeypatch):
    seen = []
    write_line = RecordingWriter._write_line

    def looked(self, line):
        seen.append(
            all((tmp_path / path).is_file() for path in RecordedGrasp.from_row(json.loads(line)).images().values())
        )
        write_line(self, line)

    monkeypatch.setattr(RecordingWriter, "_write_line", looked)
    two_grasps(tmp_path)
    assert seen == [True, True]


@pytest.mark.parametrize("step", range(1, 7))
def test_a_failure_while_a_recording_is_made_can_be_tried_again(tmp_path, monkeypatch, step):
    failing = Failing(monkeypatch, OSError(28, "No space left on device"), step)
    with contextlib.suppress(RobotError), failing:
        RecordingWriter(tmp_path / "r", INFO).close()
    assert failing.count >= step
    with RecordingWriter(tmp_path / "r", INFO) as writer:
        writer.append("1", "mug", pictures())
    assert ids(tmp_path / "r") == ["1"]


def test_a_process_that_is_killed_leaves_whole_grasps(tmp_path):
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
    with RecordingWriter(tmp_path / "r", INFO) as writer:  # the lock went with the process
        writer.append("2", "mug", pictures())
    assert ids(tmp_path / "r") == ["1", "2"]
