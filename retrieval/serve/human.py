"""The paths of the human test (`retrieval.serve.trials`)."""

import secrets
import time
from string import ascii_lowercase
from typing import Annotated

from fastapi import APIRouter, Request, Response
from fastapi import Path as InPath
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool

from retrieval.data.images import read_bytes
from retrieval.serve.catalogue import PICTURES, shown_picture
from retrieval.serve.errors import Problem, problems
from retrieval.serve.service import Keeping, Parts, Service
from retrieval.serve.store import Choice, Run, Store, new_id
from retrieval.serve.trials import CHOICES, Share, Trial, Trials, results
from retrieval.serve.uploads import RequestBody, json_body, read_json

router = APIRouter(tags=["human test"])
Number = Annotated[int, InPath(ge=1, le=10_000)]


class NewRun(RequestBody):
    """A series to be done: how many trials, by whom; the same seed gives the same trials."""

    count: int = Field(20, ge=1, le=10_000)
    who: str = Field("", max_length=200)
    seed: int | None = Field(None, ge=0, lt=2**31)


class RunDocument(BaseModel):
    """A series and how it stands. next: the first trial that was not done, null at the end."""

    id: str
    who: str
    seed: int
    count: int
    choices: int
    answered: int
    next: int | None
    human: Share
    model: Share
    chance: float


class TrialsDocument(BaseModel):
    """What can be done, and the series so far."""

    recording: str
    objects: int
    choices: int
    runs: list[RunDocument]


class TrialDocument(BaseModel):
    """A trial. choice, truth, model: counted from 1, and null until it was done."""

    number: int
    touches: list[str]
    photos: list[str]
    choice: int | None = None
    truth: int | None = None
    model: int | None = None


class ChoiceBody(RequestBody):
    """The photo that shows the object, counted from 1."""

    choice: int = Field(ge=1, le=CHOICES)


def _ready(parts: Service) -> tuple[Trials, Store]:
    if parts.trials is None:
        raise Problem("unknown", "this service has no recording to test people on; start it with --trials RECORDING")
    keeping: Keeping | None = parts.keeping
    if keeping is None:
        raise Problem("unknown", "this service keeps nothing, and so no trials; start it without --no-history")
    return parts.trials, keeping.store


def _document(run: Run, store: Store) -> RunDocument:
    chosen = store.choices(run.id)
    human, model = results(chosen)
    left = set(range(1, run.count + 1)) - {one.number for one in chosen}
    return RunDocument(
        **vars(run),
        choices=CHOICES,
        answered=len(chosen),
        next=min(left, default=None),
        human=human,
        model=model,
        chance=1 / CHOICES,
    )


def _run(parts: Service, name: str) -> Run:
    trials, store = _ready(parts)
    found = next((run for run in store.runs(trials.folder.name) if run.id == name), None)
    if found is None:
        raise Problem("unknown", f"there is no series of trials {name[:64]!r} for {trials.folder.name}")
    return found


def _trial(parts: Service, run: Run, number: int) -> Trial:
    if number > run.count:
        raise Problem("unknown", f"this series has {run.count} trials; got {number}")
    return _ready(parts)[0].trial(parts.generations.current, run.seed, number)


@router.get("/v1/trials", responses=problems("unknown"))
def trials(parts: Parts) -> TrialsDocument:
    """The objects that the model never saw, and the series of trials so far."""
    known, store = _ready(parts)
    return TrialsDocument(
        recording=known.folder.name,
        objects=len(known.unseen(parts.generations.current)),
        choices=CHOICES,
        runs=[_document(run, store) for run in store.runs(known.folder.name)],
    )


@router.post(
    "/v1/trials", status_code=201, responses=problems("unknown", "bad-input"), openapi_extra=json_body("NewRun")
)
async def begin(request: Request, parts: Parts) -> RunDocument:
    """Begin a series."""
    body = await read_json(request, NewRun)

    def made() -> RunDocument:
        known, store = _ready(parts)
        seed = secrets.randbelow(2**31) if body.seed is None else body.seed
        known.trial(parts.generations.current, seed, 1)  # says what is missing
        run = Run(new_id(), time.time(), body.who, seed, body.count, known.folder.name)
        store.add_run(run)
        return _document(run, store)

    return await run_in_threadpool(made)


@router.get("/v1/trials/{name}", responses=problems("unknown"))
def series(name: str, parts: Parts) -> RunDocument:
    """How a series stands: the person's share beside the model's in the same trials."""
    return _document(_run(parts, name), _ready(parts)[1])


@router.get("/v1/trials/{name}/{number}", responses=problems("unknown", "bad-input"))
def trial(name: str, number: Number, parts: Parts) -> TrialDocument:
    """A trial; what is right is told when it was done."""
    run = _run(parts, name)
    drawn = _trial(parts, run, number)
    done = next((one for one in _ready(parts)[1].choices(name) if one.number == number), None)
    where = f"/v1/trials/{name}/{number}"
    return TrialDocument(
        number=number,
        touches=[f"{where}/touches/{finger}" for finger in ascii_lowercase[: len(drawn.grasp.touches)]],
        photos=[f"{where}/photos/{place}" for place in range(1, CHOICES + 1)],
        **({"choice": done.choice, "truth": done.truth, "model": done.model} if done else {}),
    )


@router.post(
    "/v1/trials/{name}/{number}",
    responses=problems("unknown", "bad-input", "conflict", "busy"),
    openapi_extra=json_body("ChoiceBody"),
)
async def choose(request: Request, name: str, number: Number, parts: Parts) -> TrialDocument:
    """Choose, once; what was right and what the model chose is in the answer."""
    body = await read_json(request, ChoiceBody)
    known, store = _ready(parts)
    drawn = await run_in_threadpool(lambda: _trial(parts, _run(parts, name), number))
    model = await parts.queue.do(lambda opened: known.model_choice(opened, drawn), request)
    choice = Choice(number, body.choice, drawn.truth, model)
    if not await run_in_threadpool(store.choose, name, choice):
        raise Problem("conflict", f"trial {number} was done already")
    return await run_in_threadpool(trial, name, number, parts)


@router.get(
    "/v1/trials/{name}/{number}/touches/{finger}",
    response_class=Response,
    responses={**PICTURES, **problems("unknown")},
)
def touch(name: str, number: Number, finger: str, parts: Parts) -> Response:
    """A gel image of the grasp."""
    files = _trial(parts, _run(parts, name), number).grasp.touches
    place = ascii_lowercase.find(finger) if len(finger) == 1 else -1
    if not 0 <= place < len(files):
        raise Problem("unknown", f"the grasp has no finger {finger[:10]!r}")
    return shown_picture(read_bytes(files[place]))


@router.get(
    "/v1/trials/{name}/{number}/photos/{place}",
    response_class=Response,
    responses={**PICTURES, **problems("unknown")},
)
def photo(name: str, number: Number, place: Annotated[int, InPath(ge=1, le=CHOICES)], parts: Parts) -> Response:
    """One of the photos, counted from 1."""
    return shown_picture(read_bytes(_trial(parts, _run(parts, name), number).photos[place - 1]))
