"""Collect a recording with a rig on its own, as in the paper; a person only changes objects where the rig is real.

Object by object and attempt by attempt: photo, cylinder, random grasp, gel images before, during and after, lift, what
the gripper felt, and the gate, which decides what training keeps. What it rejects is recorded too, and attempts that
came to no grasp are logged (robot.recording.attempt_log). `grasps` accepted ones are wanted of each object, in a
bounded number of attempts: an object that is not grasped is reported, not tried for ever. One that cannot be grasped
at all is skipped, and recording.json says why; the others are collected.

A recording is written by one writer in one order, so that it is the same whatever the number of jobs, and a
collection that was stopped or killed goes on where it was when it is started again.
"""

import atexit
import functools
import json
import re
import time
import zlib
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from robot.errors import RecordingError, RobotConfigError
from robot.grasping.attempt import AttemptRunner, GraspAttempt
from robot.grasping.gates import ContactAreaGate, Gate, GraspFrames, apply_gate
from robot.grasping.settings import AttemptSettings
from robot.recording.attempt_log import UNGRASPABLE, AttemptLog, LoggedAttempt, Tally, tally
from robot.recording.folder import INFO_FILE, RecordingWriter, read_info, software_version
from robot.recording.grasp import check_name
from robot.rig import Rig
from robot.storage import decode_picture
from robot.workers import Work, WorkerPool

RigMaker = Callable[[], Rig]
"""Builds a rig, unconnected; for several jobs picklable, as functools.partial(load_rig, "sim", seed=0) is."""

_ATTEMPTS_PER_GRASP, _SPARE_ATTEMPTS = 4, 10
_UNSAFE_CHARACTERS = re.compile(r"[^A-Za-z0-9._-]")
_TOUCH = re.compile(r"touch_([a-z])")


@dataclass(frozen=True)
class CollectSettings:
    """Accepted grasps of each object, and the most attempts (None: 4 a grasp and 10).

    attempt: how they are made (None: as the rig has it).

    >>> robot.CollectSettings(grasps=2).limit
    18
    """

    grasps: int = 44
    most_attempts: int | None = None
    attempt: AttemptSettings | None = None

    def __post_init__(self) -> None:
        """Raises RobotConfigError for a number below 1."""
        if self.grasps < 1 or self.limit < 1:
            raise RobotConfigError(f"grasps and most_attempts must be at least 1, got {self.grasps} and {self.limit}")

    @property
    def limit(self) -> int:
        """Most attempts at one object."""
        default = _ATTEMPTS_PER_GRASP * self.grasps + _SPARE_ATTEMPTS
        return default if self.most_attempts is None else self.most_attempts


@dataclass(frozen=True)
class Progress:
    """How far a collection is. settled: accepted grasps, and those that objects given up will never have."""

    objects: int
    objects_done: int
    grasps_wanted: int
    grasps_done: int
    accepted: int
    attempts: int
    seconds_left: float | None

    @property
    def accept_rate(self) -> float:
        """Share of the attempts that gave an accepted grasp."""
        return self.accepted / self.attempts if self.attempts else 0.0

    def __str__(self) -> str:
        done = f"{self.objects_done} of {self.objects} objects"
        return f"{done}, {self.accept_rate:.0%} of {self.attempts} attempts accepted"


def collect(
    make_rig: RigMaker,
    out: str | Path,
    *,
    objects: int | Sequence[str],
    seed: int,
    settings: CollectSettings | None = None,
    gate: Gate | None = None,
    gate_name: str | None = None,
    jobs: int = 1,
    progress: Callable[[Progress], None] | None = None,
) -> list[Tally]:
    """Collect grasps into a recording, or go on with the one that is there.

    Args:
        make_rig: Builds the rig. It is called once, and with jobs > 1 in every process too.
        out: Folder of the recording.
        objects: Names, or how many of the rig's objects.
        seed: Of the planner's and the rig's random choices.
        settings: How many grasps of each object, in how many attempts.
        gate: Decides which grasps are accepted (`robot.grasping.gates`).
        gate_name: Which gate it is; it must be the same when a collection goes on.
        jobs: Processes, each with a rig of its own.
        progress: Called after each attempt.

    Returns:
        What came of every object.

    Raises:
        RobotConfigError: An argument is out of range.
        RecordingError: The folder holds something else, or was collected otherwise.
        DeviceError: A device failed too often.
        StorageError: The disk refused.
        What was recorded before is whole, and the rig is closed with its jaws open, unless the error says that they
        could not be opened. After Ctrl-C, too.

    >>> import functools
    >>> rig, settings = functools.partial(robot.load_rig, "sim", seed=3), robot.CollectSettings(grasps=1)
    >>> [tally.accepted for tally in robot.collect(rig, "collected", objects=2, seed=3, settings=settings)]
    [1, 1]
    """
    settings, gate = settings or CollectSettings(), gate or ContactAreaGate()
    rig = make_rig()
    if jobs < 1:
        raise RobotConfigError(f"jobs must be at least 1, got {jobs}")
    if jobs > 1 and not rig.can_run_jobs:
        raise RobotConfigError(f"there is one such rig ({type(rig).__name__}), so jobs must be 1, got {jobs}")
    names = rig.object_ids(objects) if isinstance(objects, int) else list(objects)
    if not names:
        raise RobotConfigError("at least one object must be collected, got none")
    if len(set(names)) != len(names):
        raise RobotConfigError("objects must have different names; one was given twice")
    for name in names:
        check_name("an object's name", name)
    with rig:
        attempt = settings.attempt or rig.attempt
        info = _recording_info(rig, seed, replace(settings, attempt=attempt), gate_name or repr(gate))
        _check_can_continue(Path(out), info, strict=rig.can_run_jobs)
        attempter = AttemptRunner(rig, seed, attempt)
        with RecordingWriter(out, info) as writer, AttemptLog(Path(out), writer.grasp_ids) as log:
            collection = _Collection(writer, log, names, settings, gate, progress)
            with WorkerPool(jobs, attempter.run, functools.partial(_make_work, make_rig, seed, attempt)) as workers:
                collection.run(workers)
    return [collection.tallies[name] for name in names]


def _make_work(make_rig: RigMaker, seed: int, settings: AttemptSettings) -> Work[GraspAttempt]:
    rig = make_rig()
    rig.connect()
    atexit.register(rig.close)
    return AttemptRunner(rig, seed, settings).run


# What the recording says of its collection ------------------------------------------------------------------


def _recording_info(rig: Rig, seed: int, settings: CollectSettings, gate_name: str) -> dict[str, Any]:
    """recording.json: the rig's own, and all that a collection depends on."""
    info = {
        **rig.info,
        "seed": seed,
        "background": "before each grasp" if settings.attempt and "before" in settings.attempt.outputs else "none",
        "devices": rig.settings(),
        "collection": {"gate": gate_name, **asdict(settings), "most_attempts": settings.limit},
    }
    try:
        return dict(json.loads(json.dumps(info, allow_nan=False)))
    except (TypeError, ValueError) as error:
        raise RobotConfigError(f"what the rig says of itself must be plain JSON: {error}") from error


def _check_can_continue(folder: Path, grasps_wanted: Mapping[str, Any], strict: bool) -> None:
    """Raise RecordingError where a recording that exists was collected otherwise.

    strict: simulated attempts depend on the software and on what their devices say. Those of a real rig go on after it
    was brought up to date, and with devices that read back another exposure: what was asked of them must be the same.
    """
    if not (folder / INFO_FILE).is_file():
        return
    found = read_info(folder)
    if "collection" not in found:
        raise RecordingError(f"{folder} holds a recording that was not collected by a rig; give another folder")
    if strict:
        grasps_wanted = {**grasps_wanted, "software_version": software_version()}
    else:
        grasps_wanted = {name: value for name, value in grasps_wanted.items() if name != "devices"}
    if "gels" not in found:  # older software did not say them
        grasps_wanted = {name: value for name, value in grasps_wanted.items() if name != "gels"}
    for name, value in _flatten(grasps_wanted).items():
        old = _flatten(found).get(name)
        if old != value:
            what = name.replace("collection.", "").replace("_", " ")
            raise RecordingError(
                f"{folder} was collected with {what} {old!r}, not {value!r}; give another folder, or the same settings"
            )


def _flatten(info: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested keys joined by dots."""
    flat: dict[str, Any] = {}
    for key, value in info.items():
        flat |= _flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


# Collecting -------------------------------------------------------------------------------------------------


class _Collection:
    """Decides which attempts are made, and writes down what came of them."""

    def __init__(
        self,
        writer: RecordingWriter,
        log: AttemptLog,
        names: Sequence[str],
        settings: CollectSettings,
        gate: Gate,
        progress: Callable[[Progress], None] | None,
    ) -> None:
        self.writer, self.log, self.names, self.settings, self.gate = writer, log, names, settings, gate
        _check_log(log, writer, names)
        self.tallies = {name: Tally(name) for name in names} | tally(log.attempts)
        self._seconds = log.attempts[-1].ended_s if log.attempts else 0.0
        self._pending: dict[str, deque[Callable[[], GraspAttempt]]] = defaultdict(deque)
        self._progress = progress
        self._start, self._done_at_start = time.monotonic(), self._count_done()

    def run(self, workers: WorkerPool[GraspAttempt]) -> None:
        """Attempts are recorded object by object; workers may be ahead, but never make one that is not wanted."""
        self._record_skipped_objects()  # a crash may have come between a line of the log and this
        self._report()
        for name in self.names:
            while self._needs_attempt(name):
                self._submit_ahead(workers, name)
                self._record(self._pending[name].popleft()())
                self._report()
            self._pending.pop(name, None)  # of an object that turned out to be ungraspable

    def _submit_ahead(self, workers: WorkerPool[GraspAttempt], name: str) -> None:
        """Give out the attempts that are wanted next, this object's first."""
        later = self.names[self.names.index(name) :]
        for each in later:
            while self._needs_attempt(each, ahead=True):
                if sum(map(len, self._pending.values())) >= workers.window and self._pending[name]:
                    return
                number = self.tallies[each].attempts + len(self._pending[each])
                self._pending[each].append(workers.submit(each, number))

    def _needs_attempt(self, name: str, ahead: bool = False) -> bool:
        """Whether another attempt is needed, if all that are under way are going to be accepted."""
        under_way, so_far = len(self._pending[name]) if ahead else 0, self.tallies[name]
        if so_far.skipped is not None:
            return False
        return so_far.accepted + under_way < self.settings.grasps and so_far.attempts + under_way < self.settings.limit

    def _record(self, attempt: GraspAttempt) -> None:
        """Ask the gate, write the attempt's line and then its grasp."""
        began, self._seconds = self._seconds, round(self._seconds + attempt.duration_s, 3)
        logged = self._log_entry(attempt)
        self.log.append(logged)
        if logged.grasp_id is not None:
            self.writer.append(
                logged.grasp_id,
                attempt.object_id,
                attempt.images,
                **attempt.fields,
                grasped=logged.accepted,
                outcome=attempt.outcome,
                sequence_id=logged.grasp_id,
                time_s=round(began + attempt.touch_time_s, 3),
            )
        self.tallies[attempt.object_id].add(logged)
        if attempt.outcome == UNGRASPABLE:
            self._record_skipped_objects()

    def _record_skipped_objects(self) -> None:
        """Have recording.json name the objects that cannot be grasped, where there are any."""
        if skipped := {name: why for name in self.names if (why := self.tallies[name].skipped) is not None}:
            self.writer.update_info(skipped_objects=skipped)

    def _log_entry(self, attempt: GraspAttempt) -> LoggedAttempt:
        logged = functools.partial(
            LoggedAttempt, attempt.object_id, attempt.number, attempt.outcome, ended_s=self._seconds
        )
        if attempt.outcome in ("no_plan", UNGRASPABLE):
            return logged(accepted=False, reason=attempt.reason)
        accepted, score = apply_gate(self.gate, RecordedTouches(attempt.images))
        grasp_id = grasp_id_of(attempt.object_id, attempt.number)
        return logged(accepted=accepted, grasp_id=grasp_id, score=score, fit=attempt.fit)

    def _count_done(self) -> int:
        grasps_wanted = self.settings.grasps
        return sum(self.tallies[name].accepted if self._needs_attempt(name) else grasps_wanted for name in self.names)

    def _report(self) -> None:
        if self._progress is None:
            return
        tallies = [self.tallies[name] for name in self.names]
        grasps_wanted, grasps_done = len(tallies) * self.settings.grasps, self._count_done()
        fresh = grasps_done - self._done_at_start
        left = (grasps_wanted - grasps_done) * (time.monotonic() - self._start) / fresh if fresh else None
        self._progress(
            Progress(
                objects=len(tallies),
                objects_done=sum(not self._needs_attempt(name) for name in self.names),
                grasps_wanted=grasps_wanted,
                grasps_done=grasps_done,
                accepted=sum(each.accepted for each in tallies),
                attempts=sum(each.attempts for each in tallies),
                seconds_left=left,
            )
        )


def _check_log(log: AttemptLog, writer: RecordingWriter, names: Sequence[str]) -> None:
    """The log must tell of every grasp, in the order in which this collection makes its attempts."""
    logged = {attempt.grasp_id for attempt in log.attempts} - {None}
    if lost := writer.grasp_ids - logged:
        raise RecordingError(f"{log.folder}: attempts.jsonl lacks grasp {min(lost)}; restore it or give a new folder")
    order = list(tally(log.attempts))
    if order != list(names[: len(order)]):
        raise RecordingError(
            f"{log.folder} was collected with other objects ({', '.join(order[:3])}, ...); give the same or more"
        )


def grasp_id_of(object_id: str, number: int) -> str:
    """The grasp's id: object and number of the attempt, in characters that file names may have."""
    plain = _UNSAFE_CHARACTERS.sub("_", object_id)[:100]
    if plain != object_id or not plain[0].isalnum():
        plain = f"x{zlib.crc32(object_id.encode()):08x}_{plain}"
    return f"{plain}-{number:04}"


class RecordedTouches(Mapping[str, GraspFrames]):
    """Each finger's frames as they are recorded, for the gate judges what training will see; decoded when it looks."""

    def __init__(self, images: Mapping[str, bytes]) -> None:
        self._images = images
        self._fingers = [match[1] for column in images if (match := _TOUCH.fullmatch(column))]

    def __getitem__(self, finger: str) -> GraspFrames:
        before, during, after = (self._decode(f"touch_{finger}{moment}") for moment in ("_before", "", "_after"))
        if during is None:
            raise KeyError(finger)
        return GraspFrames(before, during, after)

    def _decode(self, column: str) -> npt.NDArray[np.uint8] | None:
        if column not in self._images:
            return None
        pixels = decode_picture(self._images[column])
        assert pixels is not None, "it was encoded by robot.grasping.attempt"
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)

    def __iter__(self) -> Iterator[str]:
        return iter(self._fingers)

    def __len__(self) -> int:
        return len(self._fingers)
