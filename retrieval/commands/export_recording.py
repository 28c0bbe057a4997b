"""`retrieve export-recording`: write a recording as a LeRobot data set."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import SPLIT, Recording, read_split
from retrieval.console.output import say
from retrieval.console.progress import CountedBar


def export_recording(
    recording: Recording,
    *,
    out: Annotated[Path, typer.Option(help="new folder to write; an export that fails leaves no folder")],
    split: Annotated[
        Path | None, typer.Option(help=f"{SPLIT}, exported as separate parts (default: all as train)")
    ] = None,
) -> None:
    """Write a recording as a LeRobot data set, version 3."""
    from robot.export_lerobot import export_lerobot
    from robot.recording.folder import read_recording

    objects = read_split(split)
    source = read_recording(recording)
    parts = None if objects is None else {part: getattr(objects, part) for part in ("train", "validation", "test")}
    with CountedBar("export", "grasps") as bar:
        result = export_lerobot(source, out, parts=parts, progress=bar)
    for note in (*source.notes, *result.notes):
        say(note)
    say(f"{out}: {result.grasps} grasps as a LeRobot data set")
