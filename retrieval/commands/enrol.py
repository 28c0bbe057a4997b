"""`retrieve enrol`: remember touches of an object."""

from typing import Annotated

import typer

from retrieval.commands.options import (
    GELSIGHT,
    Background,
    Index,
    IndexModel,
    Json,
    Opening,
    OptionValues,
    refuse_options,
    resolve_index,
)
from retrieval.console.output import print_json, say, show
from retrieval.errors import BadInput

RECOMMENDED = 3
"""Touches of an object, each at another place."""


def enrol(
    name: Annotated[
        str, typer.Argument(metavar="OBJECT", help="object of the index, or a new one", show_default=False)
    ],
    *,
    gelsight: Annotated[list[OptionValues] | None, GELSIGHT] = None,
    opening: Opening = None,
    background: Background = None,
    index: Index = None,
    model: IndexModel = None,
    remove: Annotated[bool, typer.Option("--remove", help="delete the enrolled touches of the object")] = False,
    json: Json = False,
) -> int:
    """Remember touches of an object, so that queries find it.

    The pictures are copied to the folder of the index. The index answers with them at once, and builds keep them.
    """
    path = resolve_index(index)
    if remove:
        from retrieval.indexing.enrolled import remove_enrolled

        refuse_options("has no effect with --remove", gelsight=gelsight, opening=opening, background=background)
        removed, count = remove_enrolled(path, name)
        if json:
            print_json({"object_id": removed, "removed": count})
        else:
            show(f"{removed}: {count} enrolled touch(es) removed")
        return 0
    if not gelsight:
        raise BadInput("give the gel images of each grasp with --gelsight, or --remove")
    from retrieval.search.searcher import Searcher

    with Searcher.open(path, model=model) as searcher:
        enrolled = searcher.enrol(name, gelsight, opening_mm=opening or None, background=background)
    if json:
        print_json(enrolled._asdict())
    else:
        show(f"{enrolled.object_id}: {enrolled.touches} enrolled touch(es), {enrolled.added} new")
    more = "`retrieve query` and running services find it now"
    if enrolled.touches < RECOMMENDED:
        more += f"; {RECOMMENDED - enrolled.touches} more at other places of the object make it surer"
    say(more)
    return 0
