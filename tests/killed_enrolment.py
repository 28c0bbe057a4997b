"""Kill two writers of enrolled touches at random moments, again and again: nothing is lost, and nothing is half there.

    python -m tests.killed_enrolment KILLS CATALOGUE INDEX MODEL MODEL

Each writer enrols and removes touches of its own objects, and builds the index with one of the models; in a tenth of
its steps the disk is full. It writes what it does to a log before and after.
"""

import os
import random
import resource
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch

from _touch_retrieval.files import file_digest
from indexes.errors import IndexesError
from retrieval.errors import RetrievalError
from retrieval.indexing.build import build_index
from retrieval.indexing.enrolled import EnrolledTable, remove_enrolled
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.searcher import Searcher

FULL_DISK_BYTES = (100, 600, 3000)


def in_child(work, *arguments):
    """Start a process for `work`; this one never computes with PyTorch, whose threads a fork would lack."""
    if child := os.fork():
        return child
    os._exit(work(*arguments) or 0)


def enrol(index, *words, **options):
    with Searcher.open(index) as searcher:
        return searcher.enrol(*words, **options)


def limit_files(size=resource.RLIM_INFINITY):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def write(catalogue, index, models, writer, seed, log):
    draw, rng = random.Random(f"{seed}{writer}"), np.random.default_rng([seed, ord(writer)])
    while True:
        name, what = f"{writer}{draw.randrange(9)}", draw.choice(["enrol"] * 4 + ["remove", "build"])
        os.write(log, f"{what} {name}\n".encode())
        if draw.random() < 0.1:
            limit_files(draw.choice(FULL_DISK_BYTES))
        try:
            if what == "enrol":
                enrol(index, name, list(rng.integers(0, 256, (2, 8, 8, 3), np.uint8)))
            elif what == "remove":
                remove_enrolled(index, name)
            else:
                limit_files()
                build_index(catalogue, load_checkpoint(draw.choice(models)), index)
            outcome = "done"
        except (RetrievalError, IndexesError):  # the disk is full, another build runs, or nothing is enrolled
            outcome = "failed"
        limit_files()
        os.write(log, f"{outcome}\n".encode())


def check(catalogue, index, model):
    """Check that the next build and writer use every touch and delete what killed writers left."""
    report = build_index(catalogue, load_checkpoint(model), index)
    enrol(index, "check", [np.full((8, 8, 3), grey, np.uint8) for grey in (50, 200)])
    remove_enrolled(index, "check")
    touches = EnrolledTable(index).read()
    assert not touches or report.enrolled["usable"] == len(touches)
    with Searcher.open(index) as searcher:
        for touch in touches[-2:]:
            best = searcher.query([str(index / path) for path in touch.pictures], top=99).results
            cosines = {match.object_id: match.reference and match.reference.cosine for match in best}
            assert cosines[touch.object_id] > 0.999
    used = {str(index / path) for touch in touches for path in touch.pictures}
    assert {str(path) for path in (index / "enrolled").glob("*/*")} == used


def main(kills, catalogue, index, *models):
    torch.set_num_threads(1)
    draw, log_file, counts, operations = random.Random(0), index.with_name("log"), Counter(), Counter()
    for number in range(kills):
        logs = {}
        for writer in "ab":
            logs[writer] = os.open(f"{log_file}-{writer}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
        children = [in_child(write, catalogue, index, models, writer, number, log) for writer, log in logs.items()]
        time.sleep(draw.uniform(0.1, 1.5))
        for child in children:
            os.kill(child, signal.SIGKILL)
            assert os.waitpid(child, 0)[1] == signal.SIGKILL
        maybe = []
        for writer, log in logs.items():
            os.close(log)
            lines = Path(f"{log_file}-{writer}").read_text().split("\n")[:-1]
            for step, outcome in zip(lines[::2], [*lines[1::2], "killed"][: len(lines[::2])], strict=True):
                what, name = step.split()
                operations[what, outcome] += 1
                after = counts[name] + 1 if what == "enrol" else 0 if what == "remove" else counts[name]
                if outcome == "done":
                    counts[name] = after
                elif outcome == "killed":
                    maybe.append((name, after))
        touches = EnrolledTable(index).read()
        found = Counter(touch.object_id for touch in touches)
        for name, after in maybe:
            counts[name] = after if found[name] == after else counts[name]
        assert found == +counts, (number, found - counts, counts - found)
        for touch in touches:
            assert {path: file_digest(index / path) for path in touch.pictures} == touch.pictures
        assert os.waitpid(in_child(check, catalogue, index, draw.choice(models)), 0)[1] == 0
    print(f"{kills} kills of two writers; {sum(counts.values())} touches left; {dict(operations)}")


if __name__ == "__main__":
    main(int(sys.argv[1]), *map(Path, sys.argv[2:]))
