"""Routes of queries: one object, several objects, and verification."""

from fastapi import APIRouter, Request
from pydantic import Field

from retrieval.serve.documents import BatchDocument, QueryDocument, VerificationDocument
from retrieval.serve.errors import DocumentResponse
from retrieval.serve.service import Parts
from retrieval.serve.uploads import (
    QUERY_BODY,
    Base64Image,
    BatchBody,
    Grasps,
    ParsedQuery,
    RequestBody,
    RequestPictures,
    json_body,
    read_json,
    read_query,
)

router = APIRouter(tags=["queries"])


@router.post(
    "/v1/query",
    response_model=QueryDocument,
    openapi_extra={"requestBody": QUERY_BODY},
    summary="Which object is in the hand?",
)
async def query(request: Request, parts: Parts) -> DocumentResponse:
    """Return the document of `retrieve query --json` for one or several grasps of one object."""
    parts.queue.require_capacity()
    parsed_query = await read_query(request, parts.generations.current.fingers)
    result = await parts.queue.submit(
        lambda generation: generation.searcher.query(parsed_query.pictures.images[0], **parsed_query.keywords),
        request,
        parsed_query.options.deadline_ms,
        parsed_query.pictures,
        parsed_query,
    )
    parts.metrics.count_answer(result)
    query_id = None
    if parts.history_writer is not None:
        query_id = await parts.history_writer.add_query(parsed_query.pictures, result)
    return DocumentResponse(result.to_dict(), headers={"x-query-id": query_id} if query_id else None)


@router.post("/v1/query/batch", response_model=BatchDocument, openapi_extra=json_body(BatchBody))
async def query_batch(request: Request, parts: Parts) -> DocumentResponse:
    """Return one answer for each of several objects, in their order; their touches are encoded together."""
    parts.queue.require_capacity()
    body = await read_json(request, BatchBody)
    parsed_query = ParsedQuery(RequestPictures(body.objects, body.background, is_batch=True), body)
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
    openapi_extra=json_body(VerifyBody),
    summary="Is the expected object in the hand?",
)
async def verify(request: Request, parts: Parts) -> DocumentResponse:
    """Return the document of `retrieve verify --json`."""
    parts.queue.require_capacity()
    body = await read_json(request, VerifyBody)
    pictures = RequestPictures([body.touches], body.background)
    found = await parts.queue.submit(
        lambda generation: generation.searcher.verify(
            pictures.images[0], body.expect, far=body.far, background=pictures.frames
        ),
        request,
        pictures=pictures,
    )
    return DocumentResponse(found.to_dict())
