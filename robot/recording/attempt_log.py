"""The log attempts.jsonl (the result of every attempt, with or without a grasp), and the acceptance by object.

The file lies in the recording's folder. A line contains object_id, number, outcome, accepted and ended_s (seconds of
rig time since the recording began), and the session if it has a name. If there was a grasp, it adds grasp_id, the
gate's score and fit (method, position and size of the cylinder); else it adds the reason. The outcome "ungraspable"
ends the attempts at its object. A line is written before its grasp. After a crash, only the last line may be
incomplete or without its grasp; such a line is ignored.
"""

import contextlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from _touch_retrieval.documents import typed
from robot.errors import RecordingError
from robot.recording.grasp import Outcome
from robot.storage import LineFile, complete_lines, parse_object, read_content, storage_errors

ATTEMPTS_FILE = "attempts.jsonl"
AttemptOutcome = Outcome | Literal["ungraspable"]


@dataclass(frozen=True)
class LoggedAttempt:
    """One line of attempts.jsonl."""

    object_id: str
    number: int
    outcome: AttemptOutcome
    accepted: bool
    ended_s: float
    grasp_id: str | None = None
    score: float | None = None
    fit: Mapping[str, Any] | None = None
    reason: str | None = None
    session: str | None = None


def read_attempts(folder: Path, grasp_ids: Set[str]) -> list[LoggedAttempt]:
    """Read the attempts whose grasps, if any, are in the recording; raise RecordingError for a damaged file."""
    path = folder / ATTEMPTS_FILE
    content = read_content(path, RecordingError) if path.exists() else b""
    return _parse(path, complete_lines(content).splitlines(), grasp_ids)


def _parse(path: Path, lines: Sequence[bytes], grasp_ids: Set[str]) -> list[LoggedAttempt]:
    attempts: list[LoggedAttempt] = []
    counts: Counter[str] = Counter()
    for number, line in enumerate(lines, start=1):
        try:
            attempt = typed(parse_object(line, RecordingError), LoggedAttempt, error=RecordingError)
        except RecordingError as error:
            raise RecordingError(f"{path}, line {number}: {error}") from error
        if attempt.grasp_id is not None and attempt.grasp_id not in grasp_ids:
            if number == len(lines):
                break
            raise RecordingError(f"{path}, line {number}: its grasp {attempt.grasp_id} is not in the recording")
        if attempt.number != counts[attempt.object_id]:
            raise RecordingError(
                f"{path}, line {number}: attempts must be numbered in order, the next of {attempt.object_id} is "
                f"{counts[attempt.object_id]}, got {attempt.number}; restore the file"
            )
        counts[attempt.object_id] += 1
        attempts.append(attempt)
    return attempts


class AttemptLog(contextlib.AbstractContextManager["AttemptLog"]):
    """Appends to attempts.jsonl, after removing a last line that is incomplete or lacks its grasp."""

    def __init__(self, folder: Path, grasp_ids: Set[str]) -> None:
        self.folder = folder
        with storage_errors(folder):
            self._lines = LineFile(folder / ATTEMPTS_FILE)
            try:
                lines = self._lines.read().splitlines(keepends=True)
                self.attempts = _parse(folder / ATTEMPTS_FILE, lines, grasp_ids)
                self._lines.keep(sum(map(len, lines[: len(self.attempts)])))
            except BaseException:
                self._lines.close()
                raise

    def append(self, attempt: LoggedAttempt) -> None:
        """Write one line and sync it; on failure, remove the partial line and raise StorageError."""
        row = {key: value for key, value in vars(attempt).items() if value is not None}
        data = json.dumps(row, ensure_ascii=False, allow_nan=False).encode()
        with storage_errors(self.folder):
            self._lines.append(data)
        self.attempts.append(attempt)

    def __exit__(self, *_: object) -> None:
        self._lines.close()


@dataclass
class Tally:
    """Counts of attempts and accepted grasps of one object; `skipped` is the reason why it is ungraspable."""

    object_id: str
    attempts: int = 0
    accepted: int = 0
    skipped: str | None = None

    def add(self, attempt: LoggedAttempt) -> None:
        """Count one attempt; an ungraspable one sets `skipped` and is not counted."""
        if attempt.outcome == "ungraspable":
            self.skipped = attempt.reason
            return
        self.attempts += 1
        self.accepted += attempt.accepted


def tally(attempts: Iterable[LoggedAttempt]) -> dict[str, Tally]:
    """Count the attempts by object, in order of first appearance."""
    tallies: dict[str, Tally] = {}
    for attempt in attempts:
        tallies.setdefault(attempt.object_id, Tally(attempt.object_id)).add(attempt)
    return tallies


def acceptance_table(tallies: Sequence[Tally], grasps_target: int) -> str:
    """Return a plain-text table with a line for each object.

    Objects with fewer accepted grasps than `grasps_target` are marked "gave up", or show why they are ungraspable.
    """
    width = max([len(counts.object_id) for counts in tallies] + [6])
    lines = [f"{'object':{width}}  accepted  of"]
    for counts in tallies:
        gave_up = "  gave up" if counts.accepted < grasps_target else ""
        remark = f"  skipped: {counts.skipped}" if counts.skipped else gave_up
        lines.append(f"{counts.object_id:{width}}  {counts.accepted:>8}  {counts.attempts:>2}{remark}")
    return "\n".join(lines)
