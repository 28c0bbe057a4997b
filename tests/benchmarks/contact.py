"""`python -m tests.benchmarks.contact [--json]`: the contact solver and the closing jaws, error beside run time.

Four tables: closed forms, hard cases, and the points of error against run time of the solver and of the closing step.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterator

from retrieval.lab.contact.closed_forms import Check
from retrieval.lab.frontier.contact import Point, closed_form_table, closing_points, contact_points, stability_sweep
from retrieval.lab.hard_cases.contact import HardCase

Row = Check | HardCase | Point


def rows() -> Iterator[Row]:
    """Every row of every table."""
    yield from closed_form_table()
    yield from stability_sweep()
    yield from contact_points()
    yield from closing_points()


def as_text(row: Row) -> str:
    """One line for people."""
    if isinstance(row, Check):
        end = "" if row.holds else "  EXCEEDED"
        return f"{row.case:36} {row.quantity:30} {row.grid:8} {row.error:11.3g} {row.unit} (limit {row.limit:g}){end}"
    if isinstance(row, HardCase):
        end = "" if row.holds else "  FAILED"
        return f"{row.case}: must hold: {row.must_hold}; naive: {row.naive}; ours: {row.ours}{end}"
    cost = f"{1e3 * row.seconds:8.2f} ms {row.error:9.3g} {row.unit}"
    return f"{row.approximation:36} {row.setting:36} {cost} against {row.reference}"


def main(arguments: list[str] | None = None) -> None:
    """Print every row as soon as it is there; with --json one document a line."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.contact", description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON document a line")
    as_json = parser.parse_args(arguments).json
    for row in rows():
        print(
            json.dumps({"table": type(row).__name__, **dataclasses.asdict(row)}) if as_json else as_text(row),
            flush=True,
        )


if __name__ == "__main__":
    main()
