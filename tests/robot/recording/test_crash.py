"""A failure at any step of writing leaves complete grasps, and the writer can continue."""

import builtins
import contextlib
import os
import resource
import threading

import pytest

from robot.errors import RobotError, StorageError
from robot.recording.folder import RecordingWriter
from tests.robot.recording.test_recording import INFO, ids, pictures, pixels, two_grasps


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
    expected = (StorageError, ": No space left on device") if isinstance(error, OSError) else (KeyboardInterrupt, "^$")
    with RecordingWriter(tmp_path, INFO) as writer:
        for step in range(1, STEPS + 1):
            with Failing(monkeypatch, error, step), pytest.raises(expected[0], match=expected[1]):
                writer.append("3", "cup", pictures(3))
            assert (tmp_path / "metadata.jsonl").read_bytes() == before
            assert not list(tmp_path.rglob("*.part"))
            assert set(writer.grasp_ids) == {"1", "2"}
        with Failing(monkeypatch, None) as steps:
            writer.append("3", "cup", pictures(3))
    assert steps.count == STEPS
    assert ids(tmp_path) == ["1", "2", "3"]


def test_an_error_names_the_file_and_a_partially_written_line_is_removed(tmp_path):
    """The limit for files cuts a large picture, and the line after 40 bytes."""
    end = (two_grasps(tmp_path) / "metadata.jsonl").stat().st_size
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with RecordingWriter(tmp_path, INFO) as writer:
        resource.setrlimit(resource.RLIMIT_FSIZE, (end + 40, hard))
        try:
            with pytest.raises(StorageError, match=r"3_photo\.png could not be written: File too large"):
                writer.append("3", "cup", {**pictures(), "photo": pixels(height=99)})
            with pytest.raises(StorageError, match="could not be written: File too large"):
                writer.append("3", "cup", pictures())
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert (tmp_path / "metadata.jsonl").stat().st_size == end
        writer.append("3", "cup", pictures())
    assert ids(tmp_path) == ["1", "2", "3"]


def test_a_recording_can_be_created_after_a_failure_at_any_step(tmp_path, monkeypatch):
    for step in range(1, 7):
        folder = tmp_path / str(step)
        failing = Failing(monkeypatch, OSError(28, "No space left on device"), step)
        with contextlib.suppress(RobotError), failing:
            RecordingWriter(folder, INFO).close()
        assert failing.count >= step
        assert ids(two_grasps(folder)) == ["1", "2"]


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
