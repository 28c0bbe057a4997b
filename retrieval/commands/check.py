"""`retrieve check`: report the problems of a recording."""

import dataclasses

from retrieval.commands.options import Json, Recording, SplitFile, read_split
from retrieval.console.output import print_json, say
from retrieval.errors import RetrievalError


def check(recording: Recording, *, split: SplitFile = None, json: Json = False) -> None:
    """Check a recording for broken files, duplicates, leakage and swapped folders."""
    from retrieval.data.check.recording import check_recording
    from retrieval.data.dataset import recording_licence

    findings, licence = check_recording(recording, read_split(split)), recording_licence(recording)
    if json:
        print_json({"findings": list(map(dataclasses.asdict, findings)), "licence": dataclasses.asdict(licence)})
    for finding in findings:
        say(f"{finding.severity}: {finding.message}")
    say(f"licence of the data: {licence}")
    errors, warnings = (sum(finding.severity == severity for finding in findings) for severity in ("error", "warning"))
    say(f"{recording}: {errors} error(s), {warnings} warning(s)")
    if errors:
        raise RetrievalError(f"{recording} is not suitable for training; see the errors above")
