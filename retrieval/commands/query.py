"""`retrieve query`: find the object in the hand."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import (
    COUNT,
    FRACTION,
    Background,
    GelSight,
    Index,
    IndexModel,
    Json,
    Opening,
    resolve_index,
)
from retrieval.console.files import require_output, write_output
from retrieval.console.output import print_json, say


def query(
    *,
    gelsight: GelSight,
    background: Background = None,
    opening: Opening = None,
    index: Index = None,
    model: IndexModel = None,
    top: Annotated[int, typer.Option(parser=COUNT, help="number of objects to return")] = 10,
    none_prior: Annotated[
        float,
        typer.Option(metavar="P", parser=FRACTION, help="prior probability that the object is not in the catalogue"),
    ] = 0.5,
    json: Json = False,
    html: Annotated[Path | None, typer.Option(help="also write an HTML page with photos and gel images")] = None,
) -> int:
    """Find the catalogue photo of the object in the hand."""
    path = resolve_index(index)
    from retrieval.search.answer import EXIT_CODES, verdict_sentence
    from retrieval.search.searcher import Searcher

    if html:
        require_output(html, ".html")
    searcher = Searcher.open(path, model=model)
    result = searcher.query(gelsight, background=background, opening_mm=opening or None, top=top, none_prior=none_prior)
    if html:
        from retrieval.report.query import query_page

        write_output(html, query_page(result, searcher.catalogue))
        say(f"page: {html}")
    say(f"model: {result.index['model']} (trained on: {result.index['trained_on']})")
    if json:
        print_json(result.to_dict())
    else:
        from retrieval.report.terminal import print_table

        print_table(result)
    if opening and result.posterior and not result.posterior["opening"]["compared_objects"]:
        say("openings: not used; no reference touch of the index has one, or the model has no calibration of openings")
    say(verdict_sentence(result))
    return EXIT_CODES[result.verdict]
