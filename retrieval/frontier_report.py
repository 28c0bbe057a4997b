"""`retrieve frontier`: error against run time of every approximation, and the hard cases of every numerical kernel.

What the simulated rig has to say is handed over: only the command line knows it.
"""

import json
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from retrieval import cli, defaults
from retrieval.errors import BadInput, RetrievalError
from retrieval.files import PAGE, RESULTS, require_ours, write_output
from retrieval.frontier.run import measure
from retrieval.frontier.sample import QUICK, Sample, Scale, Simulation
from retrieval.frontier.stability import Source, lines, run_hard_cases
from retrieval.output import say
from retrieval.report.frontier import write_frontier
from retrieval.report.stability import write_stability

SEED = 40_000
"""Of the objects that are collected; the shipped checkpoint was trained on other seeds."""


def report_frontier(
    out: Path,
    *,
    model: str | None,
    recording: Path | None,
    simulation: Simulation,
    only: Sequence[str] = (),
    quick: bool = False,
) -> dict[str, Any]:
    """Measure and write `out`/frontier.json, frontier.html and figures/; returns what the first holds.

    recording: grasps of objects that the model has not seen; None collects a few on the simulated rig, if a row needs
    them. What is there from an earlier run of the same is used again. Raises the errors of `retrieval.frontier.run`.
    """
    _require_ours(out, "frontier")
    path, why = defaults.find_model(model)
    say(f"model: {path} ({why})")
    out.mkdir(parents=True, exist_ok=True)
    grasps = partial(_recording, recording, out, quick)
    sample = Sample(path, grasps, simulation, out / "features", QUICK if quick else Scale())
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
    words = ["collect", "--rig", "sim", "--objects", str(objects), "--grasps", str(grasps), "--seed", str(SEED)]
    words += ["--jobs", str(os.cpu_count() or 1), "--out", str(out / "recording")]
    say("$ retrieve " + " ".join(words))
    if code := cli.main(words):
        failure = BadInput if code == BadInput.exit_code else RetrievalError
        raise failure("`retrieve collect` failed; what it said stands above")
    return out / "recording"


def report_stability(out: Path, *, robot: Source) -> dict[str, Any]:
    """Run the hard cases and write `out`/stability.json and stability.html; returns what the first holds.

    robot: gives those of the simulated rig. "failed" counts those that do not hold.
    """
    _require_ours(out, "stability")
    from indexes.hard_cases import hard_cases as of_indexes
    from retrieval.hard_cases import hard_cases as of_retrieval

    document = run_hard_cases({"retrieval": of_retrieval, "indexes": of_indexes, "robot": robot})
    out.mkdir(parents=True, exist_ok=True)
    write_output(out / "stability.json", (json.dumps(document, indent=1) + "\n").encode(), RESULTS)
    for line in lines(document):
        say(line)
    say(f"page: {write_stability(out, document)}")
    return document


def _require_ours(out: Path, name: str) -> None:
    require_ours(out / f"{name}.json", RESULTS)
    require_ours(out / f"{name}.html", PAGE)
