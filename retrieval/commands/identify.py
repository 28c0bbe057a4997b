"""`retrieve identify`: grasp an object with a rig until its identity is clear."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from retrieval.commands.options import (
    COUNT,
    FRACTION,
    SEED,
    Index,
    IndexModel,
    Json,
    refuse_options,
    resolve_index,
)
from retrieval.console.interruption import resumable
from retrieval.console.output import print_json, say
from retrieval.errors import BadInput, RetrievalError

if TYPE_CHECKING:
    from retrieval.search.searcher import Searcher
    from robot.recording.grasp import RecordedGrasp


def identify(
    *,
    rig: Annotated[str, typer.Option(help="rig by name or TOML file; sim is the simulated rig")] = "sim",
    out: Annotated[Path, typer.Option(help="recording of the grasps, to write or continue")],
    object_id: Annotated[
        str | None,
        typer.Option(
            "--object",
            metavar="NAME",
            help="name of the object in the recording. A simulated rig also puts this object on the table, so it must "
            "be one of the rig's names (default: the rig's first name)",
        ),
    ] = None,
    expect: Annotated[
        str | None, typer.Option(metavar="OBJECT", help="verify this object of the catalogue instead of searching")
    ] = None,
    far: Annotated[
        float | None,
        typer.Option(metavar="RATE", parser=FRACTION, help="false-accept rate of --expect (default: 0.01)"),
    ] = None,
    enrol: Annotated[
        str | None,
        typer.Option(metavar="OBJECT", help="remember the grasps in the index, as touches of this known or new object"),
    ] = None,
    grasps: Annotated[
        int | None,
        typer.Option(
            parser=COUNT, help="largest number of accepted grasps (default: 5); with --enrol their number (default: 3)"
        ),
    ] = None,
    confidence: Annotated[
        float,
        typer.Option(
            metavar="P",
            parser=FRACTION,
            help='stop when an object, or the answer "none of these", has at least this probability',
        ),
    ] = 0.9,
    seed: Annotated[int, typer.Option(parser=SEED, help="seed of all random choices")] = 0,
    index: Index = None,
    model: IndexModel = None,
    json: Json = False,
) -> int:
    """Grasp the object with a rig until the answer is clear; stay next to a real rig. Resumes a stopped run.

    Use another --out for each object. With --enrol, the index remembers the grasps, and finds this object from then on.
    """
    if enrol is not None:
        refuse_options("asks for a known object, and --enrol adds one; give one of them", expect=expect)
    if far is not None and expect is None:
        raise BadInput("--far is the false-accept rate of --expect; give both, or neither")
    path = resolve_index(index)
    from retrieval.search.answer import EXIT_CODES, VERIFY_EXIT_CODES
    from retrieval.search.searcher import Searcher
    from robot.collection import CollectSettings, collect
    from robot.rig import load_rig

    with Searcher.open(path, model=model) as searcher:
        most = grasps or (5 if enrol is None else 3)
        run = _Run(searcher, out, expect, 0.01 if far is None else far, confidence if enrol is None else math.inf, most)
        if expect is not None:  # refuse it before the rig moves
            searcher.expected_object(expect, run.far)
        if enrol is not None:
            searcher.enrolled_name(enrol)

        loaded = load_rig(rig, seed=seed)
        if len(loaded.sensors) != searcher.reader.fingers:
            raise BadInput(
                f"the model of {path} takes {searcher.reader.fingers} gel image(s) of a grasp, but the rig {rig} "
                f"has {len(loaded.sensors)} sensor(s); give --model, or another rig"
            )
        if loaded.info["rig"] != "sim":  # a simulated rig has names of its own
            object_id = object_id or enrol
        attempts: set[int] = set()  # total counts of attempts: at the start, then after each new attempt
        with resumable(out):
            (tally,) = collect(
                lambda: loaded,
                out,
                objects=[object_id] if object_id else 1,
                seed=seed,
                settings=CollectSettings(grasps=most),
                progress=lambda now: attempts.add(now.attempts),
                is_enough=run.is_enough,
            )
        if run.answer is None:
            from robot.recording.attempt_log import read_attempts
            from robot.recording.folder import read_recording

            last = read_attempts(out, {grasp.grasp_id for grasp in read_recording(out).grasps})[-1]
            raise RetrievalError(
                f"no grasp of {tally.object_id} was accepted; the last attempt: {last.reason or last.outcome} (all "
                f"attempts are in {out}/attempts.jsonl)"
            )
        if enrol is not None and run.answer.results:
            run.remember(enrol, json)
            return 0
        if len(attempts) == 1:  # no new attempt: the hand may hold another object now
            raise BadInput(f"{out} holds a finished run: {run.sentence}. Give another --out for the next object")
    if json:
        print_json(run.answer.to_dict())
    say(run.sentence)
    if expect is not None:
        return VERIFY_EXIT_CODES[run.answer.decision]
    return EXIT_CODES[run.answer.verdict]


@dataclass
class _Run:
    """The grasps of one run; `answer` is a `QueryResult`, with an expected object a `Verification`."""

    searcher: "Searcher"
    folder: Path
    expect: str | None
    far: float
    confidence: float
    grasps: int
    touches: list[list[Path]] = field(default_factory=list)
    openings_mm: list[float | None] = field(default_factory=list)
    background: list[Path] | None = None
    answer: Any = None

    def is_enough(self, grasps: Sequence["RecordedGrasp"]) -> bool:
        """Answer from all grasps so far, print the answer, and return whether it is final."""
        from retrieval.data.opening import believed
        from retrieval.model.verification import ACCEPT, REJECT

        self.touches = [self._files(grasp.touches) for grasp in grasps]
        self.openings_mm = [believed(grasp.opening_mm) for grasp in grasps]
        self.background = self._files(grasps[-1].touches_before) if self.searcher.reader.takes_background else None
        if self.expect is None:
            self.answer = self.searcher.query(self.touches, opening_mm=self.openings_mm, background=self.background)
            none, results = self.answer.none_probability, self.answer.results
            is_final = none is not None and max(none, results[0].probability or 0.0) >= self.confidence
        else:
            self.answer = self.searcher.verify(self.touches, self.expect, far=self.far, background=self.background)
            is_final = self.answer.decision in (ACCEPT, REJECT)
        say(f"grasp {len(grasps)} of at most {self.grasps}: {self.sentence}")
        return is_final

    def remember(self, name: str, json: bool) -> None:
        """Enrol the grasps with contact, and print how many."""
        from retrieval.model.gel_check import CONTACT

        shows = [check == CONTACT for check in self.answer.grasps]
        touches, openings_mm = list(compress(self.touches, shows)), list(compress(self.openings_mm, shows))
        enrolled = self.searcher.enrol(name, touches, opening_mm=openings_mm, background=self.background)
        say(
            f"enrolled {enrolled.added} of {len(shows)} grasps as touches of {enrolled.object_id}; it has "
            f"{enrolled.touches} now"
        )
        if json:
            print_json(enrolled._asdict())

    @property
    def sentence(self) -> str:
        from retrieval.search.answer import verdict_sentence

        return str(self.answer.sentence) if self.expect else verdict_sentence(self.answer)

    def _files(self, images: Mapping[str, str]) -> list[Path]:
        return [self.folder / images[finger] for finger in sorted(images)]
