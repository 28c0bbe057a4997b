"""`retrieve check`: report the problems of a recording."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from retrieval.commands.options import Json, Recording, SplitFile, read_split
from retrieval.console.output import print_json, say
from retrieval.errors import BadInput, RetrievalError

if TYPE_CHECKING:
    from robot.recording.grasp import RecordedGrasp


def check(
    recording: Recording,
    *,
    split: SplitFile = None,
    model: Annotated[Path | None, typer.Option(help="checkpoint whose training split is checked")] = None,
    json: Json = False,
) -> None:
    """Check a recording for broken files, duplicates, leakage and swapped folders."""
    from retrieval.data.check.recording import COMPARED_COPIES, check_recording
    from retrieval.data.dataset import recording_licence
    from robot.recording.folder import read_recording

    if split and model:
        raise BadInput("give --split or --model, not both")
    objects = read_split(split)
    if model:
        from retrieval.model.checkpoint import load_checkpoint

        objects = load_checkpoint(model).split
    findings, licence = check_recording(recording, objects), recording_licence(recording)
    if json:
        found = [dataclasses.asdict(finding) for finding in findings]
        print_json({"findings": found, "licence": dataclasses.asdict(licence)})
    for finding in findings:
        if finding.kind != COMPARED_COPIES:
            say(f"{finding.severity}: {finding.message}")
    say(f"licence of the data: {licence}")
    say(f"recorded with the touches: {_other_measurements(read_recording(recording).grasps)}")
    errors, warnings = (sum(finding.severity == severity for finding in findings) for severity in ("error", "warning"))
    compared = [finding.message for finding in findings if finding.kind == COMPARED_COPIES]
    say("; ".join([f"{recording}: {errors} error(s), {warnings} warning(s)", *compared]))
    if errors:
        raise RetrievalError(f"{recording} is not suitable for training; see the errors above")


def _other_measurements(grasps: Sequence["RecordedGrasp"]) -> str:
    """Return which grasps have depth, force and opening, and the range of the numbers."""
    depth = sum(grasp.depth is not None for grasp in grasps)
    parts = [f"depth of {depth:,} of {len(grasps):,} grasps"]
    for what, unit, values in (
        ("force", "N", [grasp.force_n for grasp in grasps if grasp.force_n is not None]),
        ("opening", "mm", [grasp.opening_mm for grasp in grasps if grasp.opening_mm is not None]),
    ):
        extent = f" ({min(values):.3g} to {max(values):.3g} {unit})" if values else ""
        parts.append(f"{what} of {len(values):,}{extent}")
    return ", ".join(parts)
