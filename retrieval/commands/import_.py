"""`retrieve import`: convert a public data set, or your own pictures, to a recording."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from retrieval.commands.options import OptionValues
from retrieval.console.output import say, show
from retrieval.console.progress import Bar
from retrieval.errors import BadInput

if TYPE_CHECKING:
    from robot.recording.folder import Recording


def import_(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="data set; leave it out to list all", show_default=False),
    ] = None,
    source: Annotated[
        Path | None, typer.Argument(metavar="SRC", help="folder with the files of the data set", show_default=False)
    ] = None,
    *,
    out: Annotated[Path | None, typer.Option(help="recording folder to write or continue")] = None,
    option: Annotated[
        OptionValues | None,
        typer.Option(
            parser=OptionValues.parse, metavar="NAME=VALUE...", help="options of the data set; the list shows them"
        ),
    ] = None,
) -> None:
    """Convert a public data set, or your own pictures, to a recording."""
    from robot.importers import IMPORTERS, load_importer, options_of, read_options, title_of

    if name is None:
        width = max(map(len, IMPORTERS.names())) + 2
        for listed in sorted(IMPORTERS.names()):
            show(f"{listed:{width}}{title_of(listed)}")
            known = {option: default for option, (_, default) in options_of(load_importer(listed)).items()}
            if known:
                words = (f"{option}={shlex.quote(str(default))}" for option, default in known.items())
                show(f"{'':{width}}--option {' '.join(words)}")
        return
    options = read_options(IMPORTERS.resolve(name), option or ())
    if source is None or out is None:
        raise BadInput(f"an import needs a source folder and --out; run: retrieve import {name} SRC --out recording/")
    recording = run_importer(name, source, out, **options)
    from retrieval.data.check.recording import check_gel_layout

    for note in recording.notes:
        say(note)
    objects = len({grasp.object_id for grasp in recording.grasps})
    say(f"{out}: {len(recording.grasps)} grasps of {objects} objects")
    for finding in check_gel_layout(out):
        say(f"{finding.severity}: {finding.message}")


def run_importer(name: str, source: Path, out: Path, **options: Any) -> "Recording":
    """Import a data set from the folder `source` into the recording `out`, with a progress bar on stderr."""
    from robot.importers import load_importer

    with Bar(f"importing {name}", 0, "grasps") as bar:
        return load_importer(name)(source, out, bar.show, **options)
