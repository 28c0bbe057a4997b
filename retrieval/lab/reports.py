"""`retrieve frontier`: error against run time of every approximation, and the hard cases of every numerical kernel."""

import json
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from retrieval.console.files import PAGE, RESULTS, require_ours, write_output
from retrieval.console.output import say
from retrieval.console.progress import CollectBar
from retrieval.lab.frontier.report import write_frontier
from retrieval.lab.frontier.run import measure
from retrieval.lab.frontier.sample import QUICK, Sample, Scale
from retrieval.lab.hard_cases.report import write_stability
from retrieval.lab.hard_cases.run import lines, run_hard_cases
from retrieval.search import defaults
from robot.collect import CollectSettings, collect
from robot.rig import load_rig

SEED = 40_000
"""Of the objects that are collected; the shipped checkpoint was trained on other seeds."""


def report_frontier(
    out: Path,
    *,
    model: str | None,
    recording: Path | None,
    only: Sequence[str] = (),
    quick: bool = False,
) -> dict[str, Any]:
    """Measure and write `out`/frontier.json, frontier.html and figures/; returns what the first holds.

    recording: grasps of objects that the model has not seen; None collects a few on the simulated rig, if a row needs
    them. What is there from an earlier run of the same is used again. Raises the errors of
    `retrieval.lab.frontier.run`.
    """
    _require_ours(out, "frontier")
    path, why = defaults.find_model(model)
    say(f"model: {path} ({why})")
    out.mkdir(parents=True, exist_ok=True)
    grasps = partial(_recording, recording, out, quick)
    sample = Sample(path, grasps, out / "features", QUICK if quick else Scale())
    try:
        document = measure(sample, out, only)
    except KeyboardInterrupt:
        say(f"what was measured is kept in {out}; the same command goes on with it")
        raise
    page, *_ = write_frontier(out, document)
    say(f"page: {page}")
    return document


def _recording(given: Path | None, out: Path, quick: bool) -> Path:
    if given is not None:
        return given
    objects, grasps = (6, 2) if quick else (30, 4)
    folder = out / "recording"
    say(f"collecting {grasps} grasps of each of {objects} simulated objects into {folder}")
    with CollectBar() as bar:
        collect(
            partial(load_rig, "sim", seed=SEED),
            folder,
            objects=objects,
            seed=SEED,
            settings=CollectSettings(grasps=grasps),
            jobs=os.cpu_count() or 1,
            progress=bar,
        )
    return folder


def report_stability(out: Path) -> dict[str, Any]:
    """Run the hard cases and write `out`/stability.json and stability.html; returns what the first holds.

    "failed" counts those that do not hold.
    """
    _require_ours(out, "stability")
    document = run_hard_cases()
    out.mkdir(parents=True, exist_ok=True)
    write_output(out / "stability.json", (json.dumps(document, indent=1) + "\n").encode(), RESULTS)
    for line in lines(document):
        say(line)
    say(f"page: {write_stability(out, document)}")
    return document


def _require_ours(out: Path, name: str) -> None:
    require_ours(out / f"{name}.json", RESULTS)
    require_ours(out / f"{name}.html", PAGE)
