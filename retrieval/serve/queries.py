"""The paths of queries: one object, several, an answer grasp by grasp, and where a photo agrees with a touch."""

from fastapi import APIRouter, Request
from pydantic import Field

from retrieval.search.query.agreement import agreement
from retrieval.search.query.answer import QueryResult
from retrieval.serve.catalogue import photo_of
from retrieval.serve.documents import AgreementDocument, BatchDocument, GrowingDocument, QueryDocument
from retrieval.serve.errors import DocumentResponse, problems
from retrieval.serve.generations import Opened
from retrieval.serve.service import Parts
from retrieval.serve.uploads import (
    QUERY_BODY,
    Asked,
    BatchBody,
    Grasps,
    Picture,
    RequestBody,
    json_body,
    pictures_of,
    read_json,
    read_query,
)

router = APIRouter(tags=["queries"])
_PROBLEMS = problems("bad-input", "bad-image", "too-large", "too-slow", "unsupported-type", "busy", "late", "not-ready")


@router.post(
    "/v1/query",
    response_model=QueryDocument,
    responses=_PROBLEMS,
    openapi_extra={"requestBody": QUERY_BODY},
    summary="Which object is in the hand?",
)
async def query(request: Request, parts: Parts) -> DocumentResponse:
    """The document of `retrieve query --json` for one or several grasps of one object."""
    parts.queue.require_room()
    asked = await read_query(request, parts.generations.current.fingers)
    answered = await parts.queue.ask(asked, request)
    name = parts.keeping.keep(asked, answered) if parts.keeping else None
    return DocumentResponse(answered.result.to_dict(), headers={"x-query-id": name} if name else None)


@router.post(
    "/v1/query/growing", response_model=GrowingDocument, responses=_PROBLEMS, openapi_extra={"requestBody": QUERY_BODY}
)
async def query_growing(request: Request, parts: Parts, alone: bool = False) -> DocumentResponse:
    """How the answer changes grasp by grasp: after the first, after the first two, and so on; `alone`: and what each
    grasp says by itself."""
    parts.queue.require_room()
    asked = await read_query(request, parts.generations.current.fingers)

    def work(opened: Opened) -> dict[str, list[QueryResult]]:
        searcher, (touches,) = opened.searcher, asked.pictures.images
        each = [[grasp] for grasp in touches if alone]
        return {
            "answers": searcher.query_growing(touches, **asked.keywords),
            "alone": searcher.query_many(each, **asked.keywords),
        }

    found = await parts.queue.do(work, request, asked.options.deadline_ms, asked.pictures)
    return DocumentResponse({name: [answer.to_dict() for answer in answers] for name, answers in found.items()})


@router.post("/v1/query/batch", response_model=BatchDocument, responses=_PROBLEMS, openapi_extra=json_body("BatchBody"))
async def query_batch(request: Request, parts: Parts) -> DocumentResponse:
    """Several objects in one request: their touches are encoded together, an answer for each in their order."""
    parts.queue.require_room()
    body = await read_json(request, BatchBody)
    asked = Asked(pictures_of(body.objects, body.background, is_batch=True), body)
    answers = await parts.queue.do(
        lambda opened: opened.searcher.query_many(asked.pictures.images, **asked.keywords),
        request,
        body.deadline_ms,
        asked.pictures,
    )
    for answer in answers:
        parts.metrics.answered(answer)
    return DocumentResponse({"answers": [answer.to_dict() for answer in answers]})


class AgreementBody(RequestBody):
    """A photo of the catalogue by its id, and touches."""

    photo: str = Field(min_length=1, max_length=4096, examples=["mug/1.jpg"])
    touches: Grasps
    background: list[Picture] | None = None
    squares: int = Field(8, ge=2, le=16, description="squares of a side")


@router.post(
    "/v1/agreement",
    response_model=AgreementDocument,
    responses={**_PROBLEMS, **problems("unknown")},
    openapi_extra=json_body("AgreementBody"),
)
async def agree(request: Request, parts: Parts) -> AgreementDocument:
    """Where a photo agrees with a touch: the match logit's fall as one square after the other is hidden."""
    parts.queue.require_room()
    body = await read_json(request, AgreementBody)
    pictures = pictures_of([body.touches], body.background)

    def work(opened: Opened) -> AgreementDocument:
        photo = photo_of(opened, body.photo)
        found = agreement(
            opened.searcher,
            pictures.images[0],
            opened.searcher.catalogue / photo.path,
            background=pictures.frames,
            model=opened.checkpoint(),
            squares=body.squares,
        )
        return AgreementDocument(
            generation=opened.name,
            photo=body.photo,
            logit=found.logit,
            rows=body.squares,
            columns=body.squares,
            falls=found.falls.tolist(),
        )

    return await parts.queue.do(work, request, pictures=pictures)
