"""Results of a query for people: the table on a terminal and the self-contained HTML page."""

from pathlib import Path
from string import ascii_lowercase
from typing import Any

from retrieval.report.pictures import data_uri, jpeg, thumbnail
from retrieval.report.templates import render
from retrieval.search import QueryResult

_THUMBNAIL_PX = 320


def print_table(result: QueryResult) -> None:
    """Print the ranking on stdout, as a table."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title="Which object is in the hand?")
    for title, justify in (
        ("rank", "right"),
        ("object", "left"),
        ("probability", "right"),
        ("logit", "right"),
    ):
        # The object is the answer: folded where it is long, never cut.
        table.add_column(title, justify=justify, no_wrap=title != "object", overflow="fold")  # type: ignore[arg-type]
    table.add_column("photo", overflow="fold")
    for match in result.results:
        probability = "-" if match.probability is None else f"{match.probability:.3f}"
        # As Text: a name may hold what rich takes for markup, such as "[bold]".
        name, photo = Text(match.object_id), Text(match.photo)
        table.add_row(str(match.rank), name, probability, f"{match.logit:+.2f}", photo)
    Console().print(table)


def query_html(result: QueryResult, catalogue: Path) -> str:
    """One HTML page with the gel images, the photos and the probabilities; images are inside the file.

    A photo that has vanished since the index was built is left blank.
    """
    touches = [
        [
            {"uri": _data_uri(Path(path)), "name": Path(path).name, "finger": finger}
            for finger, path in zip(ascii_lowercase, paths, strict=False)
        ]
        for paths in result.touches
    ]
    matches: list[dict[str, Any]] = [
        {**match.to_dict(), "uri": _data_uri(catalogue / match.photo)} for match in result.results
    ]
    return render("query.html", result=result, touches=touches, matches=matches)


def _data_uri(path: Path) -> str:
    """The image, no larger than a thumbnail, as a data URI; empty where it cannot be read."""
    image = thumbnail(path, _THUMBNAIL_PX)
    return "" if image is None else data_uri(jpeg(image), "jpeg")
