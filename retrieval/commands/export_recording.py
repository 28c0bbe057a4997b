"""`retrieve export-recording`: write a recording as a LeRobot data set."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import Recording
from retrieval.console.output import say
from retrieval.console.progress import Bar


def export_recording(
    recording: Recording,
    *,
    out: Annotated[Path, typer.Option(help="new folder to write; an export that fails leaves no folder")],
) -> None:
    """Write a recording as a LeRobot data set, version 3."""
    from robot.export_lerobot import export_lerobot
    from robot.recording.folder import read_recording

    source = read_recording(recording)
    with Bar("exporting", 0, "grasps") as bar:
        notes = export_lerobot(source, out, bar.show)
    for note in (*source.notes, *notes):
        say(note)
    say(f"{out}: {len(source.grasps)} grasps as a LeRobot data set")
