"""`retrieve build-index` killed at any moment: the next query finds the old or the new catalogue, complete.

KILLS=50 python -m pytest tests/retrieval/search/test_crash.py -s     the long run, which prints counts
"""

import hashlib
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass

import pytest

from retrieval.data.catalogue import list_catalogue
from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.searcher import Searcher
from tests import synthetic

KILLS = int(os.environ.get("KILLS", "5"))
SEED = 11
DEADLINE_S = 120.0


@dataclass(frozen=True)
class Build:
    """Seconds from the start of a build until it wrote, until CURRENT changed, and until it ended."""

    pid: int
    writing_s: float | None
    current_s: float | None
    ended_s: float
    killed: bool


def command(*arguments):
    return [sys.executable, "-m", "retrieval", *map(str, arguments)]


def watched_build(catalogue, model, index, kill_at_s=math.inf, kill_writing_s=math.inf):
    """Run `retrieve build-index`, and kill it some time after its start or after it began to write, if it still runs.

    Writing begins when the folder of the unfinished generation appears.
    """
    folders, current = set(index.glob("gen-*")), (index / "CURRENT").read_text()
    arguments = command("build-index", catalogue, "--model", model, "--out", index)
    start, written, changed = time.monotonic(), None, None
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}  # starts faster on a busy machine
    with subprocess.Popen(arguments, stderr=subprocess.DEVNULL, env=environment) as process:
        while process.poll() is None:
            now = time.monotonic() - start
            assert now < DEADLINE_S
            if written is None and set(index.glob("gen-*")) - folders:
                written = now
            if changed is None and (index / "CURRENT").read_text() != current:
                changed = now
            if now >= min(kill_at_s, math.inf if written is None else written + kill_writing_s):
                process.kill()
            time.sleep(0.0005)
    assert process.returncode in (0, -signal.SIGKILL)
    return Build(process.pid, written, changed, time.monotonic() - start, process.returncode != 0)


def content(catalogue):
    """Expected rows of an index of this folder: {id: digest}."""
    listed = list_catalogue(catalogue)
    return {photo.path: hashlib.sha256(listed.read(photo.path)).hexdigest() for photo in listed.photos}


def changed_copy(catalogue, path):
    """A copy of the catalogue with one object removed, one added, and one photo replaced."""
    shutil.copytree(catalogue, path)
    objects = sorted(path.iterdir())
    shutil.rmtree(objects[0])
    shutil.copy(next(objects[1].glob("*.jpg")), objects[2] / "1.jpg")
    synthetic.write_catalogue(path, synthetic.make_objects(1, seed=60), photos_per_object=2)
    return path


def moments(count, build, rng):
    """Every other kill during or just after writing, the others at any time of the build."""
    for number in range(count):
        if number % 2:
            yield {"kill_at_s": rng.uniform(0.0, build.ended_s)}
        else:
            yield {"kill_writing_s": rng.uniform(0.0, 1.5 * (build.current_s - build.writing_s))}


def checked_rows(index, model, touch):
    """Rows of a complete index, {id: digest}, after a query on it."""
    searcher = Searcher.open(index, model=model)
    result = searcher.query([touch], top=100)
    rows = {row.path: row.digest for row in searcher.generation.rows}
    assert {match.object_id for match in result.results} == {row.object_id for row in searcher.generation.rows}
    assert result.index["scored"] == len(rows)
    return rows


@pytest.mark.slow
def test_a_killed_build_leaves_the_old_or_the_new_index_complete(catalogue, model, touch, tmp_path):
    index, rng = tmp_path / "index", random.Random(SEED)
    folders = [shutil.copytree(catalogue, tmp_path / "old"), changed_copy(catalogue, tmp_path / "new")]
    contents = [content(folder) for folder in folders]
    build_index(folders[0], load_checkpoint(model), index, quiet=True)
    uninterrupted = watched_build(folders[1], model, index)
    assert checked_rows(index, model, touch) == contents[1]
    old, outcomes = 1, Counter()
    for moment in moments(KILLS, uninterrupted, rng):
        new = 1 - old
        build = watched_build(folders[new], model, index, **moment)
        has_unfinished = any(index.glob(f"gen-*.tmp-{build.pid}"))
        rows = checked_rows(index, model, touch)
        assert rows in (contents[old], contents[new])
        assert build.killed or rows == contents[new]
        how = (
            "not killed in time"
            if not build.killed
            else "killed, unfinished folder left"
            if has_unfinished
            else "killed"
        )
        outcomes[f"{how}, {'new' if rows == contents[new] else 'old'} index"] += 1
        old = contents.index(rows)
    print(f"\n{KILLS} kills; uninterrupted: {uninterrupted}; {dict(outcomes)}")
    assert objects_by_command_line(index, touch) == sorted({name.split("/")[0] for name in contents[old]})
    build_index(folders[1 - old], load_checkpoint(model), index, quiet=True)  # the next build cleans up and continues
    assert checked_rows(index, model, touch) == contents[1 - old]
    assert list(index.glob("*.tmp-*")) == []


def objects_by_command_line(index, touch):
    """The objects that `retrieve query` ranks, in alphabetical order."""
    query = command("query", "--gelsight", *touch, "--index", index, "--top", 100, "--none-prior", 0, "--json")
    done = subprocess.run(query, capture_output=True, text=True, check=True)
    return sorted(match["object_id"] for match in json.loads(done.stdout)["results"])
