"""The page of `retrieve frontier --stability`: the hard cases of every numerical kernel, a table a package."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from retrieval.console.files import PAGE, text_bytes, write_output
from retrieval.report.document import Document, Section, Table, Text, to_html

_HEADER = ("kernel", "input", "what must hold", "naive formula", "ours", "")
_TITLES = {"retrieval": "Learning and judging", "indexes": "Vector search", "robot": "Robot and simulated rig"}


def write_stability(out: Path, document: Mapping[str, Any]) -> Path:
    """Write `out`/stability.html for the document of `stability.json`; returns the file."""
    cases, failed = document["cases"], document["failed"]
    kernels = dict.fromkeys(case["kernel"] for case in cases)
    wrong = sum(not case["naive_holds"] for case in cases)
    lead = (
        Text(
            f"{len(cases)} inputs that are stiff, extreme, degenerate or no numbers at all, of {len(kernels)} "
            "numerical kernels. Each was run just now, by the obvious formula and by ours: the obvious one fails "
            f"{wrong} of them."
        ),
        Text(f"{failed} do not hold." if failed else "What must hold does, in all of them.", warn=bool(failed)),
    )
    packages = dict.fromkeys(case["package"] for case in cases)
    sections = tuple(_section(name, [case for case in cases if case["package"] == name]) for name in packages)
    page = out / "stability.html"
    html = to_html(Document("Hard cases of every numerical kernel", lead, sections), out)
    write_output(page, text_bytes(html), PAGE)
    return page


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
    failing = frozenset((number, 5) for number, case in enumerate(cases) if not case["holds"])
    table = Table(_HEADER, rows, words=frozenset({1, 2, 3, 4, 5}), bold=failing)
    return Section(_TITLES.get(package, package), (table,))
