"""Results of a query for people: the table on a terminal."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from retrieval.answer import QueryResult


def print_table(result: QueryResult) -> None:
    """Print the ranking on stdout, as a table."""
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
