"""Tables on stdout: aligned lines that are never cut."""

import sys
from collections.abc import Collection, Sequence

from retrieval.console.output import printable, show
from retrieval.search.answer import NearestReference, QueryResult


def print_table(result: QueryResult) -> None:
    """Print the ranking of a query, with "none of these" at its end; print nothing if there is no ranking."""
    if not result.results:
        return
    rows = [
        [
            str(match.rank),
            match.object_id,
            "-" if match.probability is None else f"{match.probability:.3f}",
            "-" if match.probability_if_present is None else f"{match.probability_if_present:.3f}",
            f"{match.logit:+.2f}",
            match.photo,
            *_reference(match.reference),
        ]
        for match in result.results
    ]
    if result.none_probability is not None:
        rows.append(["-", "none of these", f"{result.none_probability:.3f}", *[""] * 6])
    header = ("rank", "object", "probability", "if present", "logit", "photo", "nearest touch", "cosine", "adds")
    count = 9 if any(match.reference for match in result.results) else 6
    print_columns("Which object is in the hand?", header[:count], [row[:count] for row in rows], words=(1, 5, 6))


def _reference(nearest: NearestReference | None) -> tuple[str, str, str]:
    """Return the nearest reference's first gel image, its cosine, and the logit that the references add."""
    if nearest is None:
        return "", "", ""
    return nearest.touch[0], f"{nearest.cosine:.2f}", "no photo" if nearest.adds is None else f"{nearest.adds:+.2f}"


def print_columns(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], words: Collection[int]) -> None:
    """Print a table.

    Args:
        title: Title, shown on a terminal only.
        header: Column headings.
        rows: Cells of each row.
        words: Columns of text, which are left-aligned; all others are right-aligned.
    """
    printable_rows = [[printable(cell) for cell in row] for row in rows]
    if sys.stdout.isatty():
        show(title)
    widths = [max(map(len, column)) for column in zip(header, *printable_rows, strict=True)]
    for row in (header, *printable_rows):
        cells = enumerate(zip(row, widths, strict=True))
        aligned = [cell.ljust(width) if at in words else cell.rjust(width) for at, (cell, width) in cells]
        show("  ".join(aligned).rstrip())
