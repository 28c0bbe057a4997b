"""`python -m benchmarks [--tower NAME ...] [--only NAME ...] [--json]`: one line for each result."""

import argparse
import dataclasses
import itertools
import json

import torch

from benchmarks import arm, build, cameras, cold, cylinder, grasp, gripper, query, rerank, step
from benchmarks.common import config_of
from retrieval.model.towers import TOWERS

BENCHMARKS = {"rerank": rerank.measure, "query": query.measure, "build": build.measure, "step": step.measure}
WITHOUT_TOWER = {
    "cylinder": cylinder.measure,
    "grasp": grasp.measure,
    "shipped": query.measure_shipped,
    "cells": rerank.measure_shipped,
    "cold": cold.measure,
    "gripper": gripper.measure,
    "arm": arm.measure,
    "cameras": cameras.measure,
}


def main() -> None:
    """Print each line as soon as it is available; with --json one document per line."""
    known = [*BENCHMARKS, *WITHOUT_TOWER]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--tower", nargs="+", choices=sorted(TOWERS), default=["small", "resnet18"])
    parser.add_argument("--only", nargs="+", choices=sorted(known), default=known)
    parser.add_argument("--json", action="store_true", help="one JSON document per line")
    arguments = parser.parse_args()
    if not arguments.json:
        print(f"{torch.get_num_threads()} threads, torch {torch.__version__}; medians, ranges over repetitions")
    for name in arguments.only:
        runs = [WITHOUT_TOWER[name]()] if name in WITHOUT_TOWER else []
        runs += [BENCHMARKS[name](config_of(tower)) for tower in arguments.tower if name in BENCHMARKS]
        for line in itertools.chain.from_iterable(runs):
            print(json.dumps(dataclasses.asdict(line)) if arguments.json else line, flush=True)


if __name__ == "__main__":
    main()
