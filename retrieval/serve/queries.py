"""Routes of queries: one object, several objects, cumulative queries, verification, and occlusion maps."""

from fastapi import APIRouter, Request
from pydantic import Field

from retrieval.search.query.agreement import agreement
from retrieval.search.query.answer import QueryResult
from retrieval.serve.catalogue import photo_of
from retrieval.serve.documents import (
    AgreementDocument,
    BatchDocument,
    CumulativeQueryDocument,
    QueryDocument,
    VerificationDocument,
)
from retrieval.serve.errors import DocumentResponse, problem_responses
from retrieval.serve.generations import ServedGeneration
from retrieval.serve.service import Parts
from retrieval.serve.uploads import (
    QUERY_BODY,
    Base64Image,
    BatchBody,
    Grasps,
    ParsedQuery,
    RequestBody,
    json_body,
    pictures_of,
    read_json,
    read_query,
)

router = APIRouter(tags=["queries"])
_PROBLEMS = problem_responses(
    "bad-input", "bad-image", "too-large", "too-slow", "unsupported-type", "busy", "late", "not-ready"
)


@router.post(
    "/v1/query",
    response_model=QueryDocument,
    responses=_PROBLEMS,
    openapi_extra={"requestBody": QUERY_BODY},
    summary="Which object is in the hand?",
)
async def query(request: Request, parts: Parts) -> DocumentResponse:
    """Return the document of `retrieve query --json` for one or several grasps of one object."""
    parts.queue.require_capacity()
    parsed_query = await read_query(request, parts.generations.current.fingers)
    answer = await parts.queue.answer(parsed_query, request)
    query_id = parts.history_writer.submit(parsed_query, answer) if parts.history_writer else None
    return DocumentResponse(answer.result.to_dict(), headers={"x-query-id": query_id} if query_id else None)


@router.post(
    "/v1/query/cumulative",
    response_model=CumulativeQueryDocument,
    responses=_PROBLEMS,
    openapi_extra={"requestBody": QUERY_BODY},
)
async def query_cumulative(request: Request, parts: Parts, per_grasp: bool = False) -> DocumentResponse:
    """Return the answers after the first grasp, after the first two, and so on.

    per_grasp: also return the answer to each single grasp.
    """
    parts.queue.require_capacity()
    parsed_query = await read_query(request, parts.generations.current.fingers)

    def work(generation: ServedGeneration) -> dict[str, list[QueryResult]]:
        searcher, (touches,) = generation.searcher, parsed_query.pictures.images
        single_grasps = [[grasp] for grasp in touches] if per_grasp else []
        return {
            "answers": searcher.query_cumulative(touches, **parsed_query.keywords),
            "per_grasp": searcher.query_many(single_grasps, **parsed_query.keywords),
        }

    results = await parts.queue.submit(work, request, parsed_query.options.deadline_ms, parsed_query.pictures)
    return DocumentResponse({key: [result.to_dict() for result in found] for key, found in results.items()})


@router.post("/v1/query/batch", response_model=BatchDocument, responses=_PROBLEMS, openapi_extra=json_body("BatchBody"))
async def query_batch(request: Request, parts: Parts) -> DocumentResponse:
    """Return one answer for each of several objects, in their order; their touches are encoded together."""
    parts.queue.require_capacity()
    body = await read_json(request, BatchBody)
    parsed_query = ParsedQuery(pictures_of(body.objects, body.background, is_batch=True), body)
    results = await parts.queue.submit(
        lambda generation: generation.searcher.query_many(parsed_query.pictures.images, **parsed_query.keywords),
        request,
        body.deadline_ms,
        parsed_query.pictures,
    )
    for result in results:
        parts.metrics.count_answer(result)
    return DocumentResponse({"answers": [result.to_dict() for result in results]})


class VerifyBody(RequestBody):
    """The expected object, touches, and the false-accept rate."""

    expect: str = Field(min_length=1, max_length=4096, examples=["mug"])
    touches: Grasps
    background: list[Base64Image] | None = None
    far: float = Field(0.01, gt=0, le=0.5, description="Fraction of other objects that is accepted.")


@router.post(
    "/v1/verify",
    response_model=VerificationDocument,
    responses=_PROBLEMS,
    openapi_extra=json_body("VerifyBody"),
    summary="Is the expected object in the hand?",
)
async def verify(request: Request, parts: Parts) -> DocumentResponse:
    """Return the document of `retrieve verify --json`."""
    parts.queue.require_capacity()
    body = await read_json(request, VerifyBody)
    pictures = pictures_of([body.touches], body.background)
    found = await parts.queue.submit(
        lambda generation: generation.searcher.verify(
            pictures.images[0], body.expect, far=body.far, background=pictures.frames
        ),
        request,
        pictures=pictures,
    )
    return DocumentResponse(found.to_dict())


class AgreementBody(RequestBody):
    """A photo of the catalogue by its id, and touches."""

    photo: str = Field(min_length=1, max_length=4096, examples=["mug/1.jpg"])
    touches: Grasps
    background: list[Base64Image] | None = None
    squares: int = Field(8, ge=2, le=16, description="Squares per side.")


@router.post(
    "/v1/agreement",
    response_model=AgreementDocument,
    responses={**_PROBLEMS, **problem_responses("unknown")},
    openapi_extra=json_body("AgreementBody"),
)
async def agree(request: Request, parts: Parts) -> AgreementDocument:
    """Return the occlusion map of a photo: for each square, the decrease of the match logit if it is hidden."""
    parts.queue.require_capacity()
    body = await read_json(request, AgreementBody)
    pictures = pictures_of([body.touches], body.background)

    def work(generation: ServedGeneration) -> AgreementDocument:
        photo = photo_of(generation, body.photo)
        found = agreement(
            generation.searcher,
            pictures.images[0],
            generation.searcher.catalogue / photo.path,
            background=pictures.frames,
            model=generation.checkpoint(),
            squares=body.squares,
        )
        return AgreementDocument(
            generation=generation.name,
            photo=body.photo,
            logit=found.logit,
            rows=body.squares,
            columns=body.squares,
            falls=found.falls.tolist(),
        )

    return await parts.queue.submit(work, request, pictures=pictures)
