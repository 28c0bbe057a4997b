"""A collection that is killed and continued, or runs in several processes, gives the same bytes as any other."""

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest

from robot.collection import CollectSettings, collect
from robot.errors import DeviceError, RobotError, StorageError
from robot.recording.folder import read_recording
from robot.rig import load_rig
from tests.fake_rig import FakeRig
from tests.robot.recording.test_crash import Failing
from tests.robot.test_collection import files
from tests.waiting import run_process, wait_until

ROOT = Path(__file__).parents[2]
NAMES = ["round-0", "thin-1", "wide-2", "round-3"]
SETTINGS = CollectSettings(grasps=2, most_attempts=8)

pytestmark = pytest.mark.usefixtures("no_fsync")  # most of the time here; the killed processes do sync


class BrokenRig(FakeRig):
    """A rig that fails in a given way at the first attempt at one object."""

    def __init__(self, seed, what):
        super().__init__(seed)
        self.what = what

    def prepare(self, object_id, number):
        super().prepare(object_id, number)
        if object_id == "thin-1":
            if self.what == "die":
                os._exit(9)
            raise ValueError("not of the contract")


def run(out, jobs=1, make=None, names=NAMES):
    return collect(make or functools.partial(FakeRig, 3), out, objects=names, seed=3, settings=SETTINGS, jobs=jobs)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Files of an undisturbed collection."""
    out = tmp_path_factory.mktemp("whole") / "r"
    run(out)
    return files(out)


CHILD = """
import functools, os, signal, sys
from robot.collection import collect
from tests.fake_rig import FakeRig
from tests.robot.test_collect_crash import NAMES, SETTINGS
real, left = os.fsync, int(sys.argv[2])
def fsync(descriptor):
    global left
    real(descriptor)
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
os.fsync = fsync
collect(functools.partial(FakeRig, 3), sys.argv[1], objects=NAMES, seed=3, settings=SETTINGS)
"""


def killed(out, syncs):
    """Collect in a process that is killed after `syncs` syncs; return whether it was killed."""
    command = [sys.executable, "-c", CHILD, str(out), str(syncs)]
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode in (0, -signal.SIGKILL), done.stderr
    return done.returncode != 0


@pytest.mark.parametrize("syncs", [*(pytest.param(syncs, marks=pytest.mark.slow) for syncs in (1, 3, 14)), 13])
def test_a_killed_collection_continues_to_the_same_bytes(tmp_path, whole, syncs):
    assert killed(tmp_path / "r", syncs)
    if syncs > 2:
        read_recording(tmp_path / "r")
    run(tmp_path / "r", jobs=2 if syncs == 13 else 1)
    assert files(tmp_path / "r") == whole


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["full", "stop"])
def test_a_collection_continues_after_a_failure_at_any_step_of_an_attempt(tmp_path, monkeypatch, error):
    """The steps are all disk calls of the first attempt: two lines and eight images."""
    names = ["round-0"]
    run(tmp_path / "whole", names=names)
    for step in range(10, 39, 4):  # earlier calls make and read the folder
        out = tmp_path / f"r{step}"
        expected = "No space left on device; earlier grasps are complete" if isinstance(error, OSError) else "^$"
        with pytest.raises((StorageError, KeyboardInterrupt), match=expected), Failing(monkeypatch, error, step):
            run(out, names=names)
        run(out, names=names)
        assert files(out) == files(tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.parametrize("session", [None, "monday"])
def test_two_jobs_of_the_simulated_rig_give_the_same_bytes_as_one(tmp_path, session):
    make, settings = functools.partial(load_rig, "sim", seed=0), CollectSettings(grasps=1)
    for jobs in (1, 2):
        collect(make, tmp_path / str(jobs), objects=2, seed=0, settings=settings, jobs=jobs, session=session)
    assert files(tmp_path / "1") == files(tmp_path / "2")


def test_a_failure_in_a_worker_is_the_same_error_here_or_a_robot_error_that_names_the_attempt(tmp_path):
    make = functools.partial(FakeRig, 3, faults={"grasp": set(range(1, 99))})
    with pytest.raises(DeviceError, match=r"attempt 0 at round-0 failed 3 time\(s\)"):
        run(tmp_path / "r", jobs=2, make=make)
    with pytest.raises(RobotError, match="attempt 0 at thin-1 failed in a worker process: ValueError: not of the con"):
        run(tmp_path / "s", jobs=2, make=functools.partial(BrokenRig, 3, "value"))


def test_a_dead_worker_raises_and_the_collection_can_continue(tmp_path, whole):
    with pytest.raises(RobotError, match="a worker process died: it was killed, or memory ran out"):
        run(tmp_path / "r", jobs=2, make=functools.partial(BrokenRig, 3, "die"))
    run(tmp_path / "r", jobs=2)
    assert files(tmp_path / "r") == whole


def test_opencv_uses_one_thread_only_while_attempts_are_made(tmp_path, monkeypatch):
    """GaussianBlur and others differ in their last digits with the number of threads."""
    monkeypatch.setattr(cv2, "getNumThreads", lambda: 5)
    counts = []
    monkeypatch.setattr(cv2, "setNumThreads", counts.append)
    run(tmp_path / "r", names=["round-0"])
    assert counts == [1, 5]


ENDLESS = """
import functools, sys
from robot.collection import CollectSettings, collect
from tests.fake_rig import FakeRig
if __name__ == "__main__":
    collect(functools.partial(FakeRig, 3), sys.argv[1], objects=10**4, seed=3, settings=CollectSettings(44), jobs=2)
"""


def children(pid):
    return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="requires /proc of Linux")
@pytest.mark.parametrize(
    "end",
    [[signal.SIGKILL], [signal.SIGINT], [signal.SIGINT, signal.SIGINT]],
    ids=["killed", "ctrl-c", "ctrl-c twice"],
)
def test_workers_exit_with_their_parent(tmp_path, end):
    """A killed parent cannot stop its workers, so they exit by themselves.

    A parent that is interrupted twice still waits for them, because an interrupted shutdown of a process pool hangs.
    """
    (tmp_path / "endless.py").write_text(ENDLESS)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(tmp_path / "endless.py"), str(tmp_path / "r")]
    with run_process(command, env=environment, cwd=ROOT) as parent:
        log = tmp_path / "r" / "attempts.jsonl"
        wait_until(lambda: log.exists() and log.read_bytes().count(b"\n") >= 3, limit_s=60.0)
        workers = children(parent.pid)
        assert len(workers) >= 2
        for each in end:
            parent.send_signal(each)
            time.sleep(0.1)
        output = parent.communicate(timeout=60)[1]
        wait_until(lambda: not any(map(is_running, workers)), limit_s=60.0)
    if signal.SIGINT in end:
        assert "KeyboardInterrupt" in output
    assert read_recording(tmp_path / "r").grasps
