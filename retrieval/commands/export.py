"""`retrieve export`: write a checkpoint's touch encoder as ONNX."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import DEFAULT_MODEL, resolve_model
from retrieval.console.output import say


def export(
    model: Annotated[str | None, typer.Argument(metavar="MODEL", help=f"checkpoint (default: {DEFAULT_MODEL})")] = None,
    *,
    out: Annotated[
        Path | None, typer.Option(help="file to write (default: next to the checkpoint, with the suffix .onnx)")
    ] = None,
) -> None:
    """Export a checkpoint's touch encoder to ONNX. With it, `query` runs without PyTorch."""
    from retrieval.model.checkpoint import load_checkpoint
    from retrieval.model.export import export as write_export

    say(f"written: {write_export(load_checkpoint(resolve_model(model)), out)}")
