"""`retrieve import`: a public data set becomes a recording."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.console.output import say


def import_(
    name: Annotated[str, typer.Argument(metavar="NAME", help="which data set; an unknown name lists the known ones")],
    source: Annotated[Path, typer.Argument(metavar="SRC", help="folder with the data set's own files")],
    *,
    out: Annotated[Path, typer.Option(help="recording folder to write")],
) -> None:
    """Turn a public data set into a recording."""
    from robot.importers import load_importer

    recording = load_importer(name)(source, out)
    for note in recording.notes:
        say(note)
    objects = len({grasp.object_id for grasp in recording.grasps})
    say(f"{out}: {len(recording.grasps)} grasps of {objects} objects")
