"""Stiff and extreme inputs of every numerical kernel: required result, result of the naive formula, and our result.

`python -m benchmarks.hard_cases` runs them and prints the table; with `--out FOLDER` it also writes stability.json and
stability.html. The exit code is 1 if a case does not hold.

Each file of hard cases is next to the tests of its kernels, `tests/<package>/<room>/hard_<kernels>.py`. It also
contains the naive formulae, which nothing else uses. A new case is one function, and one `yield` in `hard_cases` of its
file.
"""

import argparse
import json
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from retrieval.console.files import write_output
from retrieval.report.document import Document, Section, Table, Text, write_document
from retrieval.version import __version__
from tests.hard_case import HardCase

KERNELS = {
    "retrieval": (
        "tests.retrieval.model.hard_losses",
        "tests.retrieval.metrics.hard_probability",
        "tests.retrieval.training.hard_linear",
        "tests.retrieval.metrics.hard_ranking",
        "tests.retrieval.data.hard_images",
    ),
    "indexes": ("tests.indexes.hard_vectors",),
    "robot": ("tests.robot.sim.hard_contact", "tests.robot.sight.hard_sight", "tests.robot.sim.hard_gel_pictures"),
}
"""Package -> modules with the hard cases of its kernels, imported on use."""

_HEADER = ("kernel", "input", "what must hold", "naive formula", "ours", "")
_TITLES = {"retrieval": "Learning and scoring", "indexes": "Vector search", "robot": "Robot and simulated rig"}


def hard_cases(package: str) -> list[HardCase]:
    """Run every hard case of a package."""
    found: list[HardCase] = []
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of naive formulae
        for name in KERNELS[package]:
            found += import_module(name).hard_cases()
    return found


def run_hard_cases() -> dict[str, Any]:
    """Run the hard cases of every package; return the content of stability.json."""
    cases: list[dict[str, Any]] = []
    for package in KERNELS:
        for case in hard_cases(package):
            plain = {
                "holds": bool(case.holds),
                "naive_holds": bool(case.naive_holds),
            }  # JSON cannot encode numpy's bool
            cases.append({"package": package, **asdict(case), **plain})
    return {"software": __version__, "failed": sum(not case["holds"] for case in cases), "cases": cases}


def lines(document: Mapping[str, Any]) -> list[str]:
    """Return a line of text for each case, and one with the count."""
    cases = document["cases"]
    return [
        *(
            f"{'holds' if case['holds'] else 'FAILS'}  {case['kernel']}, {case['case']}: must hold: "
            f"{case['must_hold']}; naive {case['naive']}; ours {case['ours']}"
            for case in cases
        ),
        f"{len(cases) - document['failed']} of {len(cases)} hold",
    ]


def write_page(out: Path, document: Mapping[str, Any]) -> Path:
    """Write `out`/stability.html and .md for stability.json, a table for each package; return the page."""
    cases, failed = document["cases"], document["failed"]
    kernels = dict.fromkeys(case["kernel"] for case in cases)
    wrong = sum(not case["naive_holds"] for case in cases)
    lead = (
        Text(
            f"{len(cases)} inputs that are stiff, extreme, degenerate or not finite, of {len(kernels)} "
            "numerical kernels. Each was run by the naive formula and by ours. The naive formula fails on "
            f"{wrong} of them."
        ),
        Text(f"{failed} do not hold." if failed else "All of them hold.", warn=bool(failed)),
    )
    packages = dict.fromkeys(case["package"] for case in cases)
    sections = tuple(_section(name, [case for case in cases if case["package"] == name]) for name in packages)
    return write_document(Document("Hard cases of every numerical kernel", (*lead, *sections)), out, "stability")[1]


def _section(package: str, cases: Sequence[Mapping[str, Any]]) -> Section:
    rows = tuple(
        (
            case["kernel"],
            case["case"],
            case["must_hold"],
            case["naive"] if case["naive_holds"] else f"{case['naive']} (wrong)",
            case["ours"],
            "holds" if case["holds"] else "DOES NOT HOLD",
        )
        for case in cases
    )
    return Section(_TITLES.get(package, package), (Table(_HEADER, rows, words=frozenset({1, 2, 3, 4, 5})),))


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hard_cases", description=__doc__)
    parser.add_argument("--out", type=Path, help="folder for stability.json and stability.html")
    out = parser.parse_args(argv).out
    document = run_hard_cases()
    print("\n".join(lines(document)))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_output(out / "stability.json", json.dumps(document, indent=1) + "\n")
        print(f"page: {write_page(out, document)}")
    return int(document["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
