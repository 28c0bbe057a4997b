"""`retrieve import`: a public data set, or pictures of one's own, become a recording."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from retrieval.commands.options import OptionValues
from retrieval.console.output import say, show
from retrieval.console.progress import CountedBar
from retrieval.errors import BadInput

if TYPE_CHECKING:
    from robot.recording.folder import Recording


def import_(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="which data set; without it they are listed", show_default=False),
    ] = None,
    source: Annotated[
        Path | None, typer.Argument(metavar="SRC", help="folder with the data set's own files", show_default=False)
    ] = None,
    *,
    out: Annotated[Path | None, typer.Option(help="recording folder to write, or to go on with")] = None,
    option: Annotated[
        OptionValues | None,
        typer.Option(
            parser=OptionValues.parse, metavar="NAME=VALUE...", help="options of the data set, as the list has them"
        ),
    ] = None,
) -> None:
    """Turn a public data set, or pictures of your own, into a recording."""
    from robot.importers import IMPORTERS, read_options

    if name is None:
        for line in _list_importers():
            show(line)
        return
    options = read_options(IMPORTERS.resolve(name), option or ())
    if source is None or out is None:
        raise BadInput(
            f"an import needs a folder to read and one to write: retrieve import {name} SRC --out recording/"
        )
    recording = run_importer(name, source, out, **options)
    for note in recording.notes:
        say(note)
    objects = len({grasp.object_id for grasp in recording.grasps})
    say(f"{out}: {len(recording.grasps)} grasps of {objects} objects")


def run_importer(name: str, source: Path, out: Path, **options: Any) -> "Recording":
    """Import with a bar on stderr. Raises what the importer raises."""
    from robot.importers import load_importer

    with CountedBar(f"import {name}", "grasps") as bar:
        return load_importer(name)(source, out, bar, **options)


def _list_importers() -> list[str]:
    """A line for each data set, and one with its options as they are where nothing is said."""
    from robot.importers import IMPORTERS, load_importer, options_of, title_of

    lines = []
    names = sorted(IMPORTERS.names())
    width = max(map(len, names)) + 2
    for name in names:
        lines.append(f"{name:{width}}{title_of(name)}")
        options = [
            f"{each}={shlex.quote(str(default))}" for each, (_, default) in options_of(load_importer(name)).items()
        ]
        lines += [f"{'':{width}}--option {' '.join(options)}"] if options else []
    return lines
