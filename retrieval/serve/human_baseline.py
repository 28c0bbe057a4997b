"""Routes of the human baseline (`retrieval.serve.trials`)."""

import secrets
import time
from string import ascii_lowercase
from typing import Annotated, Any

from fastapi import APIRouter, Request, Response
from fastapi import Path as InPath
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from retrieval.data.images import read_bytes
from retrieval.serve.catalogue import IMAGE_RESPONSES, image_response
from retrieval.serve.errors import HttpProblem
from retrieval.serve.service import Parts, Service
from retrieval.serve.store import HistoryStore, TrialChoice, TrialRun, new_id
from retrieval.serve.trials import CHOICES, Trial, Trials, trial_accuracy
from retrieval.serve.uploads import RequestBody

router = APIRouter(tags=["human baseline"])
Number = Annotated[int, InPath(ge=1, le=10_000)]


class RunBody(RequestBody):
    """A new series of trials.

    count: number of trials; participant: name of the person; seed: the same seed gives the same trials.
    """

    count: int = Field(20, ge=1, le=10_000)
    participant: str = Field("", max_length=200)
    seed: int | None = Field(None, ge=0, lt=2**31)


class ChoiceBody(RequestBody):
    """The chosen photo, counted from 1."""

    choice: int = Field(ge=1, le=CHOICES)


def _require_trials(parts: Service) -> tuple[Trials, HistoryStore]:
    if parts.trials is None:
        raise HttpProblem(
            "unknown", "This service has no recording for the human baseline. Start it with --trials RECORDING."
        )
    if parts.history_writer is None:
        raise HttpProblem(
            "unknown", "This service stores no history, which trials require. Start it without --no-history."
        )
    return parts.trials, parts.history_writer.store


def _document(run: TrialRun, store: HistoryStore) -> dict[str, Any]:
    """Return a series and its results so far. next: the first open trial, null at the end."""
    choices = store.choices(run.id)
    remaining = set(range(1, run.count + 1)) - {one.number for one in choices}
    return {
        **vars(run),
        "choices": CHOICES,
        "completed": len(choices),
        "next": min(remaining, default=None),
        "human_baseline": trial_accuracy([one.choice == one.truth for one in choices]),
        "model": trial_accuracy([one.model == one.truth for one in choices]),
        "chance": 1 / CHOICES,
    }


def _run(parts: Service, name: str) -> TrialRun:
    trials, store = _require_trials(parts)
    found = next((run for run in store.runs(trials.folder.name) if run.id == name), None)
    if found is None:
        raise HttpProblem("unknown", f"{trials.folder.name} has no series of trials {name[:64]!r}.")
    return found


def _trial(parts: Service, name: str, number: int) -> Trial:
    run = _run(parts, name)
    if number > run.count:
        raise HttpProblem("unknown", f"This series has {run.count} trials, got number {number}.")
    return _require_trials(parts)[0].trial(parts.generations.current, run.seed, number)


@router.get("/v1/trials")
def trials(parts: Parts) -> dict[str, Any]:
    """Return the number of unseen objects, and all series of the recording."""
    known, store = _require_trials(parts)
    return {
        "recording": known.folder.name,
        "objects": len(known.unseen(parts.generations.current)),
        "choices": CHOICES,
        "runs": [_document(run, store) for run in store.runs(known.folder.name)],
    }


@router.post("/v1/trials", status_code=201)
def begin_run(body: RunBody, parts: Parts) -> dict[str, Any]:
    """Begin a series of trials."""
    known, store = _require_trials(parts)
    seed = secrets.randbelow(2**31) if body.seed is None else body.seed
    known.trial(parts.generations.current, seed, 1)  # raises if a trial is impossible
    run = TrialRun(new_id(), time.time(), body.participant, seed, body.count, known.folder.name)
    store.add_run(run)
    return _document(run, store)


@router.get("/v1/trials/{name}")
def get_run(name: str, parts: Parts) -> dict[str, Any]:
    """Return a series with the accuracy of the person and of the model in the same trials."""
    return _document(_run(parts, name), _require_trials(parts)[1])


@router.get("/v1/trials/{name}/{number}")
def trial(name: str, number: Number, parts: Parts) -> dict[str, Any]:
    """Return a trial. choice, truth, model: photo numbers counted from 1, null until the trial is done."""
    sampled_trial = _trial(parts, name, number)
    done = next((one for one in _require_trials(parts)[1].choices(name) if one.number == number), None)
    where = f"/v1/trials/{name}/{number}"
    return {
        "number": number,
        "touches": [f"{where}/touches/{finger}" for finger in ascii_lowercase[: len(sampled_trial.grasp.touches)]],
        "photos": [f"{where}/photos/{place}" for place in range(1, CHOICES + 1)],
        "choice": done and done.choice,
        "truth": done and done.truth,
        "model": done and done.model,
    }


@router.post("/v1/trials/{name}/{number}")
async def choose(body: ChoiceBody, request: Request, name: str, number: Number, parts: Parts) -> dict[str, Any]:
    """Store the choice of a trial, once; the response contains the right photo and the model's choice."""
    known, store = _require_trials(parts)
    sampled_trial = await run_in_threadpool(lambda: _trial(parts, name, number))
    model = await parts.queue.submit(lambda generation: known.model_choice(generation, sampled_trial), request)
    choice = TrialChoice(number, body.choice, sampled_trial.truth, model)
    if not await run_in_threadpool(store.choose, name, choice):
        raise HttpProblem("conflict", f"Trial {number} is done already.")
    return await run_in_threadpool(trial, name, number, parts)


@router.get("/v1/trials/{name}/{number}/touches/{finger}", response_class=Response, responses=IMAGE_RESPONSES)
def touch(name: str, number: Number, finger: str, parts: Parts) -> Response:
    """Return a gel image of the trial's grasp."""
    files = _trial(parts, name, number).grasp.touches
    place = ascii_lowercase.find(finger) if len(finger) == 1 else -1
    if not 0 <= place < len(files):
        raise HttpProblem("unknown", f"The grasp has no finger {finger[:10]!r}.")
    return image_response(read_bytes(files[place]))


@router.get("/v1/trials/{name}/{number}/photos/{place}", response_class=Response, responses=IMAGE_RESPONSES)
def photo(name: str, number: Number, place: Annotated[int, InPath(ge=1, le=CHOICES)], parts: Parts) -> Response:
    """Return one of the trial's photos, counted from 1."""
    return image_response(read_bytes(_trial(parts, name, number).photos[place - 1]))
