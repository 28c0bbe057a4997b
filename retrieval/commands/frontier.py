"""`retrieve frontier`: error against run time, and the hard cases of the numerical kernels."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import Json, Model, Values, refuse
from retrieval.console.output import print_json
from retrieval.errors import RetrievalError
from retrieval.lab.frontier import APPROXIMATIONS


def frontier(
    *,
    out: Annotated[Path, typer.Option(help="folder for frontier.json, frontier.html and plots")],
    recording: Annotated[
        Path | None, typer.Option(help="grasps of unseen objects (default: a small one is collected)")
    ] = None,
    model: Model = None,
    only: Annotated[
        Values | None,
        typer.Option(parser=Values.read, metavar="NAME...", help=f"only some of {', '.join(APPROXIMATIONS)}"),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="smallest sizes, to see that it runs; concludes nothing")
    ] = False,
    stability: Annotated[
        bool, typer.Option("--stability", help="instead: run the hard cases of every numerical kernel")
    ] = False,
    json: Json = False,
) -> None:
    """Error against run time of every approximation; goes on where it was stopped. Writes plots and a page."""
    from retrieval.lab import reports

    if stability:
        ignored = {"recording": recording, "model": model, "only": only, "quick": quick}
        refuse("is of the frontier; --stability runs every hard case, and takes --out and --json", **ignored)
        document = reports.report_stability(out)
    else:
        document = reports.report_frontier(out, model=model, recording=recording, only=only or (), quick=quick)
    if json:
        print_json(document)
    if document.get("failed"):
        raise RetrievalError(f"{document['failed']} of {len(document['cases'])} hard cases do not hold; see the page")
