"""Collection of a recording with a rig, as in the paper. With a real rig, a person changes the objects.

The gate decides whether training uses a grasp. Rejected grasps are recorded too, and attempts without a grasp are
logged (robot.recording.attempt_log). An object is complete when it has the required number of accepted grasps; the
number of attempts is limited. An ungraspable object is skipped, with the reason in recording.json.

A recording may have several sessions, one after the other. In each, every object gets its accepted grasps anew, and a
named session draws its own order of the objects, so that the order of capture does not identify them across sessions.

One writer writes all grasps in a fixed order, so the recording does not depend on the number of jobs. A collection
that was stopped or killed continues at the same point when it is started again.
"""

import atexit
import functools
import hashlib
import itertools
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from _touch_retrieval.documents import Count, check_fields, typed
from robot.errors import RecordingError, RobotConfigError
from robot.grasping.attempt import AttemptRunner, GraspAttempt
from robot.grasping.gates import ContactAreaGate, Gate, apply_gate, recorded_touches
from robot.grasping.settings import AttemptSettings
from robot.recording.attempt_log import AttemptLog, LoggedAttempt, Tally, tally
from robot.recording.folder import (
    INFO_FILE,
    RecordingWriter,
    full_info,
    read_info,
    read_recording,
    safe_name,
)
from robot.recording.grasp import RecordedGrasp, check_name
from robot.rig import Rig
from robot.workers import Work, WorkerPool

RigMaker = Callable[[], Rig]
"""Builds an unconnected rig. For several jobs it must be picklable, like functools.partial(load_rig, "sim", seed=0)."""

_ATTEMPTS_PER_GRASP, _SPARE_ATTEMPTS = 4, 10


@dataclass(frozen=True)
class CollectSettings:
    """Settings of a collection.

    Attributes:
        grasps: Accepted grasps of each object.
        most_attempts: Upper limit of attempts at each object; None for 4 attempts per grasp, plus 10.
        attempt: Settings of the attempts; None for the rig's own.
        rounds: Collect one accepted grasp of each object, then the next round. Otherwise collect object by object.

    >>> robot.CollectSettings(grasps=2).limit
    18
    """

    grasps: Count = 44
    most_attempts: Count | None = None
    attempt: AttemptSettings | None = None
    rounds: bool = False

    def __post_init__(self) -> None:
        """Raise RobotConfigError for a number below 1."""
        check_fields(self, "", RobotConfigError)

    @property
    def limit(self) -> int:
        """Largest number of attempts at one object."""
        return self.most_attempts or _ATTEMPTS_PER_GRASP * self.grasps + _SPARE_ATTEMPTS


@dataclass(frozen=True)
class Progress:
    """Counts of a collection; `grasps_done` includes the missing grasps of objects that need no further attempt."""

    objects: int
    objects_done: int
    grasps_target: int
    grasps_done: int
    accepted: int
    attempts: int

    def __str__(self) -> str:
        rate = self.accepted / self.attempts if self.attempts else 0.0
        done = f"{self.objects_done} of {self.objects} objects"
        return f"{done}, {rate:.0%} of {self.attempts} attempts accepted"


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
    session: str | None = None,
    progress: Callable[[Progress], None] | None = None,
    is_enough: Callable[[Sequence[RecordedGrasp]], bool] | None = None,
) -> list[Tally]:
    """Collect grasps into a recording, or continue an existing one.

    Args:
        make_rig: Builds the rig. It is called once here and, with jobs > 1, once in every process.
        out: Folder of the recording.
        objects: Names of the objects, or how many to collect; the rig then gives the names.
        seed: Seed of the planner's random choices, stored in recording.json; build the rig with the same seed.
        settings: Grasps and attempts for each object.
        gate: Decides which grasps are accepted (`robot.grasping.gates`).
        gate_name: Name of the gate; it must be the same when a collection continues.
        jobs: Processes, each with its own rig.
        session: Name of this session; a new name continues the recording with a new session, possibly with another
            number of grasps. Default: the rig's.
        progress: Called after each attempt.
        is_enough: Ends an object early: called with its accepted grasps of this session after each one.

    Returns:
        The counts of each object in this session.

    Raises:
        RobotConfigError: An argument is out of range.
        RecordingError: The folder contains other files, was collected with other settings, or another session began
            after this one.
        DeviceError: A device failed too often.
        StorageError: The disk refused a write.

    After any exception, Ctrl-C included, recorded grasps are complete and the rig is closed. If the exception ends an
    attempt, the jaws are opened; if that failed, the exception's message or a note on it says so.

    >>> import functools
    >>> rig, settings = functools.partial(robot.load_rig, "sim", seed=3), robot.CollectSettings(grasps=1)
    >>> [tally.accepted for tally in robot.collect(rig, "collected", objects=2, seed=3, settings=settings)]
    [1, 1]
    """
    settings, gate = settings or CollectSettings(), gate or ContactAreaGate()
    rig = make_rig()
    typed(jobs, Count, "jobs", error=RobotConfigError)
    if jobs > 1 and not rig.can_run_jobs:
        raise RobotConfigError(f"{type(rig).__name__} can run in one process only, so jobs must be 1, got {jobs}")
    names = rig.object_ids(objects) if isinstance(objects, int) else list(objects)
    for name in names:
        check_name("an object's name", name)
    if (session := rig.session if session is None else session) is not None:
        check_name("session", session)
    with rig:
        attempt = settings.attempt or rig.attempt
        info = _recording_info(rig, seed, replace(settings, attempt=attempt), gate_name or repr(gate))
        _check_can_continue(Path(out), info, strict=rig.can_run_jobs, new_counts=session is not None)
        attempter = AttemptRunner(rig, seed, attempt)
        with RecordingWriter(out, info) as writer, AttemptLog(Path(out), writer.grasp_ids) as log:
            if known := {name: dict(labels) for name in names if (labels := rig.labels(name))}:
                writer.update_info(objects=known)
            collection = _Collection(writer, log, names, session, settings, gate, progress, is_enough)
            begun = None if session is None else (session, *collection.first_attempts())
            if begun is not None:
                rig.begin_session(*begun)
            make_work = functools.partial(_make_work, make_rig, seed, attempt, begun)
            with WorkerPool(jobs, attempter.run, make_work) as workers:
                collection.run(workers)
    return [collection.tallies[name] for name in names]


def _make_work(
    make_rig: RigMaker, seed: int, settings: AttemptSettings, begun: tuple[str, Mapping[str, int], int] | None
) -> Work[GraspAttempt]:
    rig = make_rig()
    if begun is not None:
        rig.begin_session(*begun)
    rig.connect()
    atexit.register(rig.close)
    return AttemptRunner(rig, seed, settings).run


def _recording_info(rig: Rig, seed: int, settings: CollectSettings, gate_name: str) -> dict[str, Any]:
    """Return the content of recording.json: the rig's info and all settings of the collection."""
    collection = {"gate": gate_name, **asdict(settings), "most_attempts": settings.limit}
    if not settings.rounds:
        del collection["rounds"]
    has_before = settings.attempt is not None and "before" in settings.attempt.outputs
    background = "before each grasp" if has_before else "none"
    return full_info(
        {**rig.info, "seed": seed, "background": background, "devices": rig.settings(), "collection": collection}
    )


def _check_can_continue(folder: Path, expected: Mapping[str, Any], strict: bool, new_counts: bool) -> None:
    """Raise RecordingError if an existing recording was collected with other settings.

    With `strict`, the software version and the settings read back from devices must be equal too: simulated attempts
    depend on them. With a real rig, only the requested settings must be equal. With `new_counts`, the numbers of
    grasps and attempts may differ. The session and the names of objects always may: each grasp states its own.
    """
    if not (folder / INFO_FILE).is_file():
        return
    stored = read_info(folder)
    if "collection" not in stored:
        raise RecordingError(f"{folder} contains a recording that was not collected by a rig; give another folder")
    before, now = ({"collection.rounds": False, **_flatten(info)} for info in (stored, expected))
    free = {
        "rig_settings.session",
        "rig_settings.objects",
        *(("collection.grasps", "collection.most_attempts") if new_counts else ()),
    }
    for name, value in now.items():
        if (
            name not in free
            and before.get(name) != value
            and (strict or not name.startswith(("devices.", "software_version")))
        ):
            what = name.replace("collection.", "").replace("_", " ")
            raise RecordingError(
                f"{folder} was collected with {what} {before.get(name)!r}, not {value!r}; give another folder, or the "
                "same settings"
            )


def _flatten(info: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    parts = [
        _flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
        for key, value in info.items()
    ]
    return {name: value for part in parts for name, value in part.items()}


class _Collection:
    """Chooses the attempts and records their results."""

    def __init__(
        self,
        writer: RecordingWriter,
        log: AttemptLog,
        names: Sequence[str],
        session: str | None,
        settings: CollectSettings,
        gate: Gate,
        progress: Callable[[Progress], None] | None,
        is_enough: Callable[[Sequence[RecordedGrasp]], bool] | None,
    ) -> None:
        if lost := writer.grasp_ids - {attempt.grasp_id for attempt in log.attempts}:
            raise RecordingError(
                f"{log.folder}: attempts.jsonl lacks grasp {min(lost)}; restore it or give a new folder"
            )
        in_session = [attempt for attempt in log.attempts if attempt.session == session]
        order, whole = list(tally(in_session)), tally(log.attempts)
        if session is not None:
            names = sorted(names, key=lambda name: hashlib.sha256(f"{session}\n{name}".encode()).digest())
        if order != (list(names[: len(order)]) if session is None else [name for name in names if name in order]):
            raise RecordingError(
                f"{log.folder} was collected with other objects ({', '.join(order[:3])}, ...); give these objects "
                "first, in the same order; more may follow"
            )
        self.writer, self.log, self.settings, self.gate = writer, log, settings, gate
        self.names, self.session = names, session
        self.tallies = {name: Tally(name) for name in names} | tally(in_session)
        self._earlier = dict.fromkeys(self.tallies, 0)
        for name in whole.keys() & self.tallies:
            self.tallies[name].skipped = whole[name].skipped
            self._earlier[name] = whole[name].attempts - self.tallies[name].attempts
        self._seconds = log.attempts[-1].ended_s if log.attempts else 0.0
        self._pending: dict[str, deque[Callable[[], GraspAttempt]]] = defaultdict(deque)
        self._progress, self._is_enough = progress or (lambda now: None), is_enough
        self._accepted: dict[str, list[RecordedGrasp]] = defaultdict(list)
        self._ended: set[str] = set()
        for grasp in read_recording(writer.folder).grasps if is_enough and writer.grasp_ids else ():
            if grasp.grasped and grasp.session == session:  # accepted before the collection was stopped
                self._add_accepted(grasp)
        last = log.attempts[-1].session if log.attempts else session
        is_new = session is not None and not in_session
        if last != session and not is_new and any(self._needs_attempt(name, settings.grasps) for name in names):
            raise RecordingError(
                f"{log.folder}: its last attempts are of session {last!r}, and one sitting follows the other: continue "
                f"that session, or begin one with a new name, got {session!r}"
            )

    def first_attempts(self) -> tuple[dict[str, int], int]:
        """Return the arguments `first_attempts` and `stride` of `Rig.begin_session`, as if the gate accepted all."""
        step, stride = (1, len(self.names)) if self.settings.rounds else (self.settings.grasps, 1)
        return {name: step * place - stride * self._earlier[name] for place, name in enumerate(self.names)}, stride

    def run(self, workers: WorkerPool[GraspAttempt]) -> None:
        """Make and record all attempts in order; workers may work on later attempts that will be needed."""
        self._record_skipped_objects()  # after a crash, the log may have an object that recording.json lacks
        self._report()
        for target, name in self._turns():
            while self._needs_attempt(name, target):
                self._submit_ahead(workers, target, name)
                self._record(self._pending[name].popleft()())
                self._report()

    def _turns(self) -> Iterator[tuple[int, str]]:
        """Yield (target, object): attempt the object until it has `target` accepted grasps, then go on."""
        grasps = self.settings.grasps
        for target in range(1, grasps + 1) if self.settings.rounds else (grasps,):
            for name in self.names:
                yield target, name

    def _submit_ahead(self, workers: WorkerPool[GraspAttempt], target: int, name: str) -> None:
        """Submit the attempts that are needed next, those of this turn first."""
        for turn_target, object_id in itertools.dropwhile(lambda turn: turn != (target, name), self._turns()):
            while self._needs_attempt(object_id, turn_target, ahead=True):
                if sum(map(len, self._pending.values())) >= workers.window and self._pending[name]:
                    return
                number = self._earlier[object_id] + self.tallies[object_id].attempts + len(self._pending[object_id])
                self._pending[object_id].append(workers.submit(object_id, number))

    def _needs_attempt(self, name: str, target: int, ahead: bool = False) -> bool:
        """Return whether the object lacks accepted grasps and may be attempted again.

        With `ahead`, assume that all pending attempts are accepted.
        """
        pending, counts = len(self._pending[name]) if ahead else 0, self.tallies[name]
        if counts.skipped is not None or name in self._ended:
            return False
        return counts.accepted + pending < target and counts.attempts + pending < self.settings.limit

    def _record(self, attempt: GraspAttempt) -> None:
        """Apply the gate, then write the attempt's log line and its grasp."""
        began, self._seconds = self._seconds, round(self._seconds + attempt.duration_s, 3)
        name, number, outcome = attempt.object_id, attempt.number, attempt.outcome
        if outcome in ("no_plan", "ungraspable"):
            reason, session = attempt.reason, self.session
            logged = LoggedAttempt(name, number, outcome, False, self._seconds, reason=reason, session=session)
            self.log.append(logged)
        else:
            accepted, score = apply_gate(self.gate, recorded_touches(attempt.images))
            grasp_id = safe_name(name, f"{number:04}")
            logged = LoggedAttempt(
                name, number, outcome, accepted, self._seconds, grasp_id, score, attempt.fit, None, self.session
            )
            self.log.append(logged)
            grasp = self.writer.append(
                grasp_id,
                name,
                attempt.images,
                **attempt.fields,
                grasped=accepted,  # the gate's decision; `outcome` is the gripper's
                outcome=outcome,
                sequence_id=grasp_id,
                session=self.session,
                time_s=round(began + attempt.touch_time_s, 3),
            )
            if accepted and self._is_enough:
                self._add_accepted(grasp)
        self.tallies[name].add(logged)
        if outcome == "ungraspable":
            self._record_skipped_objects()
            del self._pending[name]

    def _add_accepted(self, grasp: RecordedGrasp) -> None:
        self._accepted[grasp.object_id].append(grasp)
        if self._is_enough is not None and self._is_enough(self._accepted[grasp.object_id]):
            self._ended.add(grasp.object_id)
            self._pending.pop(grasp.object_id, None)

    def _record_skipped_objects(self) -> None:
        """Write the ungraspable objects, if any, to recording.json."""
        if skipped := {name: reason for name in self.names if (reason := self.tallies[name].skipped) is not None}:
            self.writer.update_info(skipped_objects=skipped)

    def _report(self) -> None:
        tallies, target = [self.tallies[name] for name in self.names], self.settings.grasps
        open_tallies = [counts for counts in tallies if self._needs_attempt(counts.object_id, target)]
        self._progress(
            Progress(
                objects=len(tallies),
                objects_done=len(tallies) - len(open_tallies),
                grasps_target=len(tallies) * target,
                grasps_done=len(tallies) * target - sum(target - counts.accepted for counts in open_tallies),
                accepted=sum(counts.accepted for counts in tallies),
                attempts=sum(counts.attempts for counts in tallies),
            )
        )
