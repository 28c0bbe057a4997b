"""`retrieve verify`: is the object in the hand the expected one?"""

from typing import Annotated

import typer

from retrieval.commands.options import FRACTION, Background, GelSight, Index, IndexModel, Json, resolve_index
from retrieval.console.output import print_json, say


def verify(
    *,
    expect: Annotated[str, typer.Option(metavar="OBJECT", help="the expected object of the catalogue")],
    gelsight: GelSight,
    background: Background = None,
    far: Annotated[
        float,
        typer.Option(metavar="RATE", parser=FRACTION, help="false-accept rate: accepted fraction of other objects"),
    ] = 0.01,
    index: Index = None,
    model: IndexModel = None,
    json: Json = False,
) -> int:
    """Accept or reject the object in the hand as the expected one, at a stated false-accept rate."""
    path = resolve_index(index)
    from retrieval.search.answer import VERIFY_EXIT_CODES
    from retrieval.search.searcher import Searcher

    with Searcher.open(path, model=model) as searcher:
        result = searcher.verify(gelsight, expect, far=far, background=background)
    if json:
        print_json(result.to_dict())
    say(result.sentence)
    return VERIFY_EXIT_CODES[result.decision]
