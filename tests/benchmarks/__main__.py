"""`python -m tests.benchmarks [--tower NAME ...] [--only NAME ...] [--json]`: one line for each result."""

import argparse
import dataclasses
import json

import torch

from retrieval.towers import TOWERS
from tests.benchmarks import build, rerank, step
from tests.benchmarks.common import config_of

BENCHMARKS = {"rerank": rerank.measure, "build": build.measure, "step": step.measure}


def main() -> None:
    """Print every line as soon as it is there; with --json one document a line."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--tower", nargs="+", choices=sorted(TOWERS), default=["small", "resnet18"])
    parser.add_argument("--only", nargs="+", choices=sorted(BENCHMARKS), default=list(BENCHMARKS))
    parser.add_argument("--json", action="store_true", help="one JSON document a line")
    arguments = parser.parse_args()
    if not arguments.json:
        print(f"{torch.get_num_threads()} threads, torch {torch.__version__}; medians, ranges over repetitions")
    for name in arguments.only:
        for tower in arguments.tower:
            for line in BENCHMARKS[name](config_of(tower)):
                print(json.dumps(dataclasses.asdict(line)) if arguments.json else line, flush=True)


if __name__ == "__main__":
    main()
