"""`retrieve export-recording`: a recording becomes a data set of another format."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import SPLIT, Recording, read_split
from retrieval.console.output import say
from retrieval.console.progress import CountedBar


def export_recording(
    recording: Recording,
    *,
    to: Annotated[str, typer.Option(help="which format; an unknown name lists the known ones")],
    out: Annotated[Path, typer.Option(help="new folder to write; it is whole or absent")],
    split: Annotated[Path | None, typer.Option(help=f"{SPLIT} to tell apart (default: all train)")] = None,
) -> None:
    """Write a recording in another format: lerobot, imagefolder, open-x-tactile."""
    from robot.exporters import EXPORTERS
    from robot.recording.folder import read_recording

    export, objects = EXPORTERS.resolve(to), read_split(split)
    source = read_recording(recording)
    parts = None if objects is None else {part: getattr(objects, part) for part in ("train", "validation", "test")}
    with CountedBar("export", "grasps") as bar:
        written = export(source, out, parts=parts, progress=bar)
    for note in (*source.notes, *written.notes):
        say(note)
    say(f"{out}: {written.grasps} grasps as {to}")
