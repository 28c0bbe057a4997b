"""One table of our results, other libraries and lower limits, all in one run: medians and ranges of repetitions.

    python -m benchmarks.table [--only candidates query ...]

Every section is a separate process, because single-threaded ones must set the number of threads before numpy is
imported. The arms of a line run in turn. It takes about 15 minutes on two cores; lines appear as they are measured.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks import again, build, cold, peers, rerank, simulation, step
from benchmarks.common import config_of, spread

PHOTOS = 100_000
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
HEADER = "| what | ours | against | theirs | ours / theirs |\n|---|---|---|---|---|"


@dataclass(frozen=True)
class TableRow:
    """A line of the table.

    Attributes:
        what: the measured quantity.
        unit: unit of the figures.
        ours: our figures of single repetitions.
        against: name of the comparison, if any.
        theirs: its figures of single repetitions.
    """

    what: str
    unit: str
    ours: list[float]
    against: str = ""
    theirs: list[float] = dataclasses.field(default_factory=list)

    def __str__(self) -> str:
        ratio = f"{np.median(self.ours) / np.median(self.theirs):.2f}" if self.theirs else ""
        cells = (self.what, spread(self.ours, self.unit), self.against, spread(self.theirs, self.unit), ratio)
        return f"| {' | '.join(cells)} |"


def building() -> Iterator[TableRow]:
    """Yield photos per second from files to a searchable index."""
    for line in build.measure_shipped():
        arms = ("beyond", "bare", "work")
        ours, bare, work = ([line.figures["photos"] / seconds for seconds in line.each[arm]] for arm in arms)
        what = "`build-index`, shipped model, JPEG of 512 px"
        yield TableRow(what, "photos/s", ours, "its encoder alone, prepared images", bare)
        yield TableRow(what, "photos/s", ours, "decoding, cropping and encoding alone", work)
        yield TableRow("choice of the faster encoder, once per build of 256 photos or more", "s", line.each["looking"])


def query() -> Iterator[TableRow]:
    """Yield `retrieve query` in a fresh process."""
    for line in cold.measure():
        if line.each:
            backend = line.text.partition(",")[0]
            what = f"a query in a fresh process, 1,000 photos, {backend}"
            yield TableRow(f"{what}: CPU time, interpreter included", "ms", line.each["cpu_ms"])
            yield TableRow(what, "ms", line.each["total_ms"])


def candidates() -> Iterator[TableRow]:
    """Yield candidate search, and the best ten at equal recall."""
    for line in peers.named(PHOTOS):
        what = f"{line.figures['k']:,} candidates of {PHOTOS:,} x {peers.DIM}, `{line.tower}`"
        yield TableRow(what, "us", line.each["ours"], "the plain FAISS call", line.each["bare"])
    vectors = peers.drawn(PHOTOS, 0)
    with peers.faiss_call("being measured", 1):
        found = {
            line.tower: line
            for line in peers.compare_engines(
                vectors, peers.sample_queries(vectors, peers.QUERIES), f"{PHOTOS:,} vectors"
            )
        }
    pairs = {"flat": ["FAISS flat"], "ivf_sq8": ["FAISS IVF, SQ8"], "hnsw": ["FAISS HNSW", "hnswlib", "usearch"]}
    for kind, others in pairs.items():
        ours = found[f"{kind} (ours)"]
        for theirs in (found[name] for name in others if name in found):
            recalls = [line.figures["recall"] for line in (ours, theirs)]
            what = f"best {peers.BEST} of {PHOTOS:,}, `{kind}`, recall {recalls[0]:.3f}"
            against = f"{theirs.tower}, recall {recalls[1]:.3f}"
            yield TableRow(what, "us", ours.each["query_us"], against, theirs.each["query_us"])


def reranking() -> Iterator[TableRow]:
    """Yield match logits from stored partial activations."""
    for line in rerank.measure(config_of("mobilenet_v2")):
        if "product" not in line.each:
            continue  # the line that compares with and without cells
        ours, product = ([1e3 * seconds for seconds in line.each[arm]] for arm in ("partials", "product"))
        yield TableRow(
            f"{line.figures['candidates']:,} candidates reranked", "ms", ours, "the bare matrix product", product
        )


def rebuilding() -> Iterator[TableRow]:
    """Yield rebuilds, in CPU time of one thread."""
    for line in again.measure(PHOTOS):
        stat_only, all_read = "`os.walk` and `os.stat` alone", "all photos read"
        what = f"rebuild of {PHOTOS:,} photos"
        yield TableRow(
            f"{what}, one new, without its encoding: CPU", "s", line.each["one"], stat_only, line.each["looking"]
        )
        yield TableRow(f"{what}, no new photo: CPU", "s", line.each["nothing"], all_read, line.each["verify"])
        yield TableRow("encoding that one photo, the first of a process: CPU", "s", line.each["first_encoding"])
        yield TableRow("Python, imports and the model: CPU", "s", line.each["started"])


def grasping() -> Iterator[TableRow]:
    """Yield the parts of a simulated grasp, in CPU time of one thread."""
    for part, seconds in simulation.compare_checkouts({"ours": simulation.ROOT}, 3, 13, 2)["ours"].items():
        yield TableRow(f"simulated: {part}: CPU", "ms", [1e3 * each for each in seconds])


def training() -> Iterator[TableRow]:
    """Yield a training step on shared images."""
    lines = [line for _ in range(3) for line in step.measure(config_of("mobilenet_v2"), repetitions=1)]
    ours = [line.figures["ours_s"] for line in lines]
    for arm, against in (("batch", "one batch of 48 pairs"), ("one", "pair by pair")):
        theirs = [line.figures["ours_s"] * line.figures[f"ratio_{arm}"] for line in lines]
        yield TableRow("training step, 6 touches x 8 photos, MobileNetV2", "s", ours, against, theirs)


SECTIONS: dict[str, tuple[Callable[[], Iterator[TableRow]], dict[str, str]]] = {
    "building": (building, {}),
    "query": (query, {}),
    "candidates": (candidates, ONE_THREAD),
    "reranking": (reranking, ONE_THREAD),
    "rebuilding": (rebuilding, ONE_THREAD),
    "grasping": (grasping, ONE_THREAD),
    "training": (training, {}),
}


def rows(section: str) -> Iterator[TableRow]:
    """Yield the rows of a section, measured by a process with its environment."""
    command = [sys.executable, "-m", "benchmarks.table", "--section", section]
    environment = {**os.environ, **SECTIONS[section][1], "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for text in process.stdout:
            yield TableRow(**json.loads(text))
    if process.returncode:
        raise SystemExit(f"the section {section} ended with {process.returncode}")


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.table", description=__doc__.split("\n\n")[0])
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--section", choices=SECTIONS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.section:
        for row in SECTIONS[arguments.section][0]():
            print(json.dumps(dataclasses.asdict(row)), flush=True)
        return
    before = os.getloadavg()[0]
    print(HEADER, flush=True)
    for section in arguments.only:
        for row in rows(section):
            print(row, flush=True)
    print(f"\nLoad before: {before:.1f}; {os.cpu_count()} cores.")


if __name__ == "__main__":
    main()
