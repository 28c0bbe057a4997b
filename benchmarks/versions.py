"""Times of builds, queries and collection, compared with another checkout of this project.

    git worktree add ../before v0.1.0
    python -m benchmarks.versions --before ../before

Both checkouts use the installed libraries, their own shipped checkpoint, the same gel images and photos, and an index
of their own. They run in turn, each time in a new process. Run it on an idle machine: wall time is measured.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from benchmarks.common import REPETITIONS, Times, as_text, spread

ROOT = Path(__file__).parents[1]
PHOTOS, OBJECTS, GRASPS = 400, 24, 2
"""Photos of the catalogue; objects to collect, and grasps of each."""
COMMAND = "import sys; from retrieval.commands.main import main; sys.exit(main())"
"""The program `retrieve`: its process ends with the command."""
NONE_OF_THESE = 3
"""Exit code of a query with this verdict."""
ONE_QUERY = "import sys, retrieval; print(retrieval.open(sys.argv[1]).query([sys.argv[2:]]).verdict)"
WARM_QUERY = """
import sys, time, retrieval
with retrieval.open(sys.argv[1]) as searcher:
    seconds = []
    for _ in range(60):
        start = time.perf_counter()
        searcher.query([sys.argv[2:]])
        seconds.append(time.perf_counter() - start)
print(sorted(seconds[10:])[25])
"""
"""Prints the median seconds of 50 queries, after ten that are not counted."""


class Done(NamedTuple):
    """A process that has ended.

    Attributes:
        seconds: Wall time.
        cpu_s: CPU time.
        output: Text on stdout.
    """

    seconds: float
    cpu_s: float
    output: str


class Version(NamedTuple):
    """A checkout, and the folder of its indexes and recordings."""

    root: Path
    folder: Path

    def run(self, program: str, *words: object) -> Done:
        """Run a program with the packages of this checkout."""
        # -P: import no packages of the working directory.
        command = [sys.executable, "-P", "-c", program, *map(str, words)]
        environment = os.environ | {"PYTHONPATH": str(self.root.resolve())}
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        if done.returncode not in (0, NONE_OF_THESE):
            raise SystemExit(f"{' '.join(map(str, words))} of {self.root} failed: {done.stderr}")
        cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return Done(seconds, cpu_s, done.stdout)


def main() -> int:
    """Print a line for each kind of work."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.versions", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--before", type=Path, required=True, help="another checkout of this project")
    parser.add_argument("--repetitions", type=int, default=REPETITIONS)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        versions = {"before": Version(arguments.before, Path(name, "before")), "now": Version(ROOT, Path(name, "now"))}
        print("| what | before | now | before / now |\n|---|---|---|---|", flush=True)
        for line in lines(versions, Path(name), arguments.repetitions):
            print(line, flush=True)
    return 0


def lines(versions: dict[str, Version], folder: Path, repetitions: int) -> Iterator[str]:
    """Yield the lines of the table.

    Args:
        versions: The versions `before` and `now`.
        folder: Empty folder for photos, touches, indexes and recordings.
        repetitions: Number of times that each version does each kind of work; one more is not counted, because Numba
            compiles and the system reads files for the first time.
    """
    simulated = ("collect", "--rig", "sim")
    now = versions["now"]
    now.run(COMMAND, *simulated, "--photos-only", "--objects", PHOTOS, "--out", folder / "photos")
    now.run(COMMAND, *simulated, "--objects", 1, "--grasps", 1, "--out", folder / "touches")
    gels = sorted((folder / "touches" / "images").glob("*_touch_[ab].jpg"))
    collected = ("--objects", OBJECTS, "--grasps", GRASPS, "--seed", 1)

    def build(version: Version, out: Path) -> float:
        return version.run(COMMAND, "build-index", folder / "photos" / "images", "--out", out).seconds

    def collect(version: Version, out: Path, jobs: int = 1) -> float:
        return version.run(COMMAND, *simulated, *collected, "--jobs", jobs, "--out", out).seconds

    def query(version: Version) -> Done:
        return version.run(COMMAND, "query", "--gelsight", *gels, "--index", version.folder / "build 0")

    def open_and(version: Version, program: str) -> Done:
        return version.run(program, version.folder / "build 0", *gels)

    work: dict[str, Callable[[Version, int], float]] = {
        f"`retrieve build-index`, {PHOTOS} photos": lambda each, turn: build(each, each.folder / f"build {turn}"),
        "`retrieve query` in a new process": lambda each, _: query(each).seconds,
        "the same, CPU time": lambda each, _: query(each).cpu_s,
        "`retrieval.open(...).query(...)` in a new process": lambda each, _: open_and(each, ONE_QUERY).seconds,
        "a query on an open index": lambda each, _: float(open_and(each, WARM_QUERY).output),
        f"`retrieve collect`, {OBJECTS} objects, {GRASPS} grasps of each": lambda each, turn: collect(
            each, each.folder / f"one {turn}"
        ),
        "the same with `--jobs 2`": lambda each, turn: collect(each, each.folder / f"two {turn}", jobs=2),
    }
    for what, seconds in work.items():
        turns = [{name: seconds(each, turn) for name, each in versions.items()} for turn in range(1 + repetitions)]
        times = Times({name: [each[name] for each in turns[1:]] for name in versions})
        cells = [spread([1e3 * one for one in times.seconds[name]], "ms") for name in versions]
        yield f"| {what} | {' | '.join(cells)} | {as_text(times.ratio('before', 'now'))} |"


if __name__ == "__main__":
    raise SystemExit(main())
