"""Writers that die or collide: readers always find a complete index, the old one or the new one."""

import errno
import json
import os
import re
import subprocess
import sys
from contextlib import suppress

import numpy as np
import pytest

from _touch_retrieval import files
from indexes.errors import LockedIndex, NoIndex, WriteFailed
from indexes.store import folder, locking
from indexes.store.folder import IndexStore
from tests.indexes.test_store import filled, names, rows_of
from tests.waiting import first_line, run_process

STEPS = ("fsync", "rename", "replace", "mkdir", "unlink", "rmdir")

KILLED_AT_EVERY_STEP = """
import json, os, shutil, signal, sys
from pathlib import Path
import numpy as np
from indexes.store.folder import IndexStore
from indexes.store.rows import Row

STEPS = json.loads(sys.argv[2])
base, work = Path(sys.argv[1]) / "base", Path(sys.argv[1]) / "work"
OLD, NEW = ["00", "01", "02"], ["01", "03"]

def write(path, ids):
    vectors = np.eye(4, dtype=np.float32)[[int(name) for name in ids]]
    rows = [Row(name, name, name) for name in ids]
    store = IndexStore(path)
    written = store.write(rows, [{"embeddings": vectors, "partials": vectors}], documents={"calibration": {}})
    store.discard_before(written.generation)

def killed(path, number):
    steps = 0
    def wrapped(step):
        def call(*args, **options):
            nonlocal steps
            steps += 1
            if steps == number:
                os.kill(os.getpid(), signal.SIGKILL)
            return step(*args, **options)
        return call
    for name in STEPS:
        setattr(os, name, wrapped(getattr(os, name)))
    write(path, NEW)
    os._exit(0)

for _ in range(3):
    write(base, OLD)
(base / "gen-000009.tmp-1").mkdir()
states, number, alive = [], 0, False
while not alive:
    number += 1
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(base, work)
    child = os.fork()
    if child == 0:
        killed(work, number)
    alive = os.waitpid(child, 0)[1] == 0
    store = IndexStore(work)
    found = store.open()
    ids = [row.path for row in found.rows]
    assert np.array_equal(found.arrays["partials"], np.eye(4)[[int(name) for name in ids]])
    states.append("old" if ids == OLD else "new" if ids == NEW else "broken")
    write(work, NEW)
    assert [row.path for row in store.open().rows] == NEW
    left = sorted(path.name for path in work.iterdir())
    assert len(left) == 5 and left[0] == "CURRENT" and left[1] == "LOCK", left
print(json.dumps(states))
"""


def test_a_kill_at_any_filesystem_step_leaves_the_old_or_the_new_index_complete(tmp_path):
    command = [sys.executable, "-c", KILLED_AT_EVERY_STEP, str(tmp_path), json.dumps(STEPS)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, check=True, timeout=120, capture_output=True, text=True, env=environment)
    found = json.loads(done.stdout)
    assert set(found) == {"old", "new"}
    assert found == sorted(found, reverse=True)  # the switch happens once: old before it, new after it
    assert len(found) > 15


class Steps:
    """Record the calls that change the disk, and make one of them fail."""

    def __init__(self, monkeypatch, fails_at: int | None, error: BaseException | None = None) -> None:
        self.calls: list[tuple[str, str]] = []
        for name in STEPS:
            monkeypatch.setattr(os, name, self._wrapped(name, getattr(os, name), fails_at, error))

    def _wrapped(self, name, step, fails_at, error):
        def call(target, *more, **options):
            where = os.readlink(f"/proc/self/fd/{target}") if name == "fsync" else str(target)
            self.calls.append((name, os.path.basename(where)))
            if len(self.calls) == fails_at:
                raise error
            return step(target, *more, **options)

        return call


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="names of open files are read from /proc")
def test_everything_is_flushed_before_it_is_renamed(tmp_path, monkeypatch):
    filled(tmp_path)
    steps = Steps(monkeypatch, None)
    filled(tmp_path, kind="HNSW8", arrays={"partials": np.ones((20, 2))}, documents={"calibration": {}})
    suffix = f".tmp-{os.getpid()}"
    calls = [(step, re.sub(r"^\.CURRENT\..*", "temporary", name)) for step, name in steps.calls if step != "mkdir"]
    assert calls == [
        *(("fsync", name) for name in ("rows.jsonl", "rows.npy", "partials.npy", "embeddings.npy")),
        *(("fsync", name) for name in ("calibration.json", "vectors.faiss")),
        ("fsync", "manifest.json"),
        ("fsync", f"gen-000002{suffix}"),
        ("rename", f"gen-000002{suffix}"),
        ("fsync", tmp_path.name),
        ("fsync", "temporary"),
        ("replace", "temporary"),
        ("unlink", "temporary"),
        ("fsync", tmp_path.name),
    ]


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="names of open files are read from /proc")
def test_a_failing_disk_step_gives_one_error_and_a_complete_index(tmp_path, monkeypatch):
    for number in range(1, 100):
        path = tmp_path / str(number)
        filled(path)
        with monkeypatch.context() as patch:
            steps = Steps(patch, number, OSError(errno.ENOSPC, "No space left on device"))
            with suppress(WriteFailed):  # anything else fails the test
                filled(path, 5)
        assert IndexStore(path).open().count in (5, 20)
        assert filled(path, 7).count == IndexStore(path).open().count == 7
        assert not list(path.glob("*.tmp-*"))
        if len(steps.calls) < number:
            return
    raise AssertionError("the steps never ended")


def test_an_interrupted_writer_cleans_up_and_releases_the_lock(tmp_path, monkeypatch):
    filled(tmp_path)

    def interrupted(content, version):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(folder, "encode_document", interrupted)
        with pytest.raises(KeyboardInterrupt):
            filled(tmp_path, 5)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["CURRENT", "LOCK", "gen-000001"]
    assert filled(tmp_path, 5).folder.name == "gen-000002"


def test_a_writer_killed_before_the_first_switch_does_not_block_the_next(tmp_path, monkeypatch):
    def killed(path, data):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(files, "write_atomically", killed)
        with pytest.raises(KeyboardInterrupt):
            filled(tmp_path)
    with pytest.raises(NoIndex):
        IndexStore(tmp_path).open()
    assert filled(tmp_path).count == 20


HOLDING = """
import sys, time
from indexes.store.folder import IndexStore
with IndexStore(sys.argv[1]).lock():
    print("locked", flush=True)
    time.sleep(60)
"""


def test_a_writer_in_another_process_is_reported_and_its_death_releases_the_lock(tmp_path):
    filled(tmp_path)
    with run_process([sys.executable, "-c", HOLDING, str(tmp_path)]) as holder:
        first_line(holder)
        with pytest.raises(LockedIndex, match="another writer"):
            filled(tmp_path)
        assert IndexStore(tmp_path).open().count == 20  # readers do not wait
        holder.kill()
    assert filled(tmp_path, 5).count == 5


def test_a_disk_without_locks_is_not_reported_as_locked(tmp_path, monkeypatch):
    def refused(descriptor, how):
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    monkeypatch.setattr(locking.fcntl, "flock", refused)
    with pytest.raises(WriteFailed, match="does not support locks"):
        filled(tmp_path)


def test_a_generation_replaced_while_it_is_being_opened_is_read_again(tmp_path, monkeypatch):
    filled(tmp_path)
    real, turns = folder.read_generation, []

    def slow(path, **options):
        if not turns:
            turns.append(path.name)
            for _ in range(4):
                filled(tmp_path, 6)  # deletes the generation that is being read
        return real(path, **options)

    monkeypatch.setattr(folder, "read_generation", slow)
    assert IndexStore(tmp_path).open().count == 6
    assert turns == ["gen-000001"]


def test_generation_numbers_skip_one_that_never_became_current(tmp_path):
    filled(tmp_path)
    (tmp_path / "gen-000005").mkdir()
    assert filled(tmp_path).folder.name == "gen-000006"
    assert list(IndexStore(tmp_path).open().rows) == rows_of(names(20))
