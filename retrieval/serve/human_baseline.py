"""Routes of the human baseline (`retrieval.serve.trials`)."""

from collections import defaultdict
from collections.abc import Sequence
from string import ascii_lowercase
from typing import Annotated, Any

from fastapi import APIRouter, Request, Response
from fastapi import Path as InPath
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from retrieval.data.images import read_bytes
from retrieval.metrics.intervals import binomial_interval
from retrieval.serve.catalogue import IMAGE_RESPONSES, image_response
from retrieval.serve.errors import HttpProblem
from retrieval.serve.service import Parts, Service
from retrieval.serve.store import HistoryStore, TrialChoice
from retrieval.serve.trials import CHOICES, Trial, Trials
from retrieval.serve.uploads import RequestBody

router = APIRouter(tags=["human baseline"])
Participant = Annotated[str, InPath(min_length=1, max_length=200, description="Name of a person.")]
Number = Annotated[int, InPath(ge=1, le=10_000)]


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


def _trial(parts: Service, number: int) -> Trial:
    return _require_trials(parts)[0].trial(parts.generations.current, number)


def _accuracy(right: Sequence[bool]) -> dict[str, float]:
    """Return the accuracy of choices with its exact 95 % confidence interval (Clopper and Pearson 1934)."""
    low, high = binomial_interval(sum(right), len(right))
    accuracy = sum(right) / len(right)
    return {"right": sum(right), "trials": len(right), "accuracy": accuracy, "low": low, "high": high}


@router.get("/v1/trials")
def trials(parts: Parts) -> dict[str, Any]:
    """Return the number of unseen objects, and the accuracy of each person and of the model in the same trials.

    next: the number of the person's next trial.
    """
    known, store = _require_trials(parts)
    choices = defaultdict(list)
    for one in store.choices(known.folder.name):
        choices[one.participant].append(one)
    return {
        "recording": known.folder.name,
        "objects": len(known.unseen(parts.generations.current)),
        "choices": CHOICES,
        "chance": 1 / CHOICES,
        "participants": [
            {
                "participant": name,
                "next": 1 + max(one.number for one in done),
                "human_baseline": _accuracy([one.choice == one.truth for one in done]),
                "model": _accuracy([one.model == one.truth for one in done]),
            }
            for name, done in choices.items()
        ],
    }


@router.get("/v1/trials/{number}")
def trial(number: Number, parts: Parts) -> dict[str, Any]:
    """Return the pictures of a trial, which is the same for everybody."""
    fingers = len(_trial(parts, number).grasp.touches)
    return {
        "number": number,
        "touches": [f"/v1/trials/{number}/touches/{finger}" for finger in ascii_lowercase[:fingers]],
        "photos": [f"/v1/trials/{number}/photos/{place}" for place in range(1, CHOICES + 1)],
    }


@router.post("/v1/trials/{number}/{participant:path}")
async def choose(
    body: ChoiceBody, request: Request, number: Number, participant: Participant, parts: Parts
) -> dict[str, Any]:
    """Store a person's choice in a trial, once.

    choice, truth, model: photo numbers, counted from 1, of the person's choice, the right photo and the model's choice.
    """
    known, store = _require_trials(parts)
    shown = await run_in_threadpool(_trial, parts, number)
    model = await parts.queue.submit(lambda generation: known.model_choice(generation, shown), request)
    choice = TrialChoice(participant, number, body.choice, shown.truth, model)
    if not await run_in_threadpool(store.add_choice, known.folder.name, choice):
        raise HttpProblem("conflict", f"{participant} has done trial {number} already.")
    return vars(choice)


@router.get("/v1/trials/{number}/touches/{finger}", response_class=Response, responses=IMAGE_RESPONSES)
def touch(number: Number, finger: str, parts: Parts) -> Response:
    """Return a gel image of the trial's grasp."""
    files = dict(zip(ascii_lowercase, _trial(parts, number).grasp.touches, strict=False))
    if finger not in files:
        raise HttpProblem("unknown", f"The grasp has no finger {finger[:10]!r}.")
    return image_response(read_bytes(files[finger]))


@router.get("/v1/trials/{number}/photos/{place}", response_class=Response, responses=IMAGE_RESPONSES)
def photo(number: Number, place: Annotated[int, InPath(ge=1, le=CHOICES)], parts: Parts) -> Response:
    """Return one of the trial's photos, counted from 1."""
    return image_response(read_bytes(_trial(parts, number).photos[place - 1]))
