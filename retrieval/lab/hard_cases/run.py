"""The hard cases of every numerical kernel, run."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from retrieval.console.progress import Bar
from retrieval.lab.hard_cases import KERNELS, hard_cases
from retrieval.version import __version__


def run_hard_cases(quiet: bool = False) -> dict[str, Any]:
    """Run the hard cases of every package; the content of stability.json."""
    cases: list[dict[str, Any]] = []
    with Bar("hard cases", len(KERNELS), "packages", quiet=quiet) as bar:
        for package in KERNELS:
            for case in hard_cases(package):
                plain = {"holds": bool(case.holds), "naive_holds": bool(case.naive_holds)}  # numpy's bool is no JSON
                cases.append({"package": package, **asdict(case), **plain})
            bar.advance()
    return {"software": __version__, "failed": sum(not case["holds"] for case in cases), "cases": cases}


def lines(document: Mapping[str, Any]) -> list[str]:
    """A line of text for each case."""
    return [
        f"{'holds' if case['holds'] else 'FAILS'}  {case['kernel']}, {case['case']}: must hold: {case['must_hold']}; "
        f"naive {case['naive']}; ours {case['ours']}"
        for case in document["cases"]
    ]
