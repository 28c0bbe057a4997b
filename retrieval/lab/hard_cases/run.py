"""The hard cases of every numerical kernel, run: what must hold, what the naive formula gives, what ours gives."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

from retrieval.console.progress import Bar
from retrieval.version import __version__


class HardCase(Protocol):
    """A row of the table; every package has its own of these fields.

    kernel: which numerical kernel; case: its input; must_hold: what must be true; naive, ours: what came out; holds,
    naive_holds: whether it is true of ours, and of the naive formula.
    """

    @property
    def kernel(self) -> str: ...
    @property
    def case(self) -> str: ...
    @property
    def must_hold(self) -> str: ...
    @property
    def naive(self) -> str: ...
    @property
    def ours(self) -> str: ...
    @property
    def holds(self) -> bool: ...
    @property
    def naive_holds(self) -> bool: ...


Source = Callable[[], Iterable[HardCase]]
"""Gives the `HardCase`s of a package."""


def run_hard_cases(sources: Mapping[str, Source], quiet: bool = False) -> dict[str, Any]:
    """Run the hard cases of packages, by name; the content of stability.json."""
    cases: list[dict[str, Any]] = []
    with Bar("hard cases", len(sources), "packages", quiet=quiet) as bar:
        for package, hard_cases in sources.items():
            cases += [{"package": package, **_fields(case)} for case in hard_cases()]
            bar.advance()
    return {"software": __version__, "failed": sum(not case["holds"] for case in cases), "cases": cases}


def _fields(case: HardCase) -> dict[str, Any]:
    words = {name: getattr(case, name) for name in ("kernel", "case", "must_hold", "naive", "ours")}
    return {**words, "holds": bool(case.holds), "naive_holds": bool(case.naive_holds)}


def lines(document: Mapping[str, Any]) -> list[str]:
    """A line of text for each case."""
    return [
        f"{'holds' if case['holds'] else 'FAILS'}  {case['kernel']}, {case['case']}: must hold: {case['must_hold']}; "
        f"naive {case['naive']}; ours {case['ours']}"
        for case in document["cases"]
    ]
