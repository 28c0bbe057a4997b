"""Routes of queries and verification."""

from typing import Any

from fastapi import APIRouter, Request
from pydantic import Field

from retrieval.serve.errors import DocumentResponse
from retrieval.serve.service import Parts
from retrieval.serve.uploads import (
    QUERY_BODY,
    Base64Image,
    Grasps,
    Options,
    RequestBody,
    RequestPictures,
    json_body,
    read_json,
    read_query,
)

router = APIRouter(tags=["queries"])


@router.post(
    "/v1/query",
    response_model=dict[str, Any],
    openapi_extra={"requestBody": QUERY_BODY},
    summary="Which object is in the hand?",
)
async def query(request: Request, parts: Parts) -> DocumentResponse:
    """Return the document of `retrieve query --json` for one or several grasps of one object."""
    parts.queue.require_capacity()
    pictures, options = await read_query(request, parts.generations.current.fingers)
    result = await parts.queue.submit(
        lambda generation: generation.searcher.query(
            pictures.images, background=pictures.frames, **options.model_dump(include=set(Options.model_fields))
        ),
        request,
        pictures,
    )
    query_id = await parts.history_writer.add_query(pictures, result) if parts.history_writer else None
    return DocumentResponse(result.to_dict(), headers={"x-query-id": query_id} if query_id else None)


class VerifyBody(RequestBody):
    """The expected object, touches, and the false-accept rate."""

    expect: str = Field(min_length=1, max_length=4096, examples=["mug"])
    touches: Grasps
    background: list[Base64Image] | None = None
    far: float = Field(0.01, gt=0, le=0.5, description="Fraction of other objects that is accepted.")


@router.post(
    "/v1/verify",
    response_model=dict[str, Any],
    openapi_extra=json_body(VerifyBody),
    summary="Is the expected object in the hand?",
)
async def verify(request: Request, parts: Parts) -> DocumentResponse:
    """Return the document of `retrieve verify --json`."""
    parts.queue.require_capacity()
    body = await read_json(request, VerifyBody)
    pictures = RequestPictures(body.touches, body.background)
    found = await parts.queue.submit(
        lambda generation: generation.searcher.verify(
            pictures.images, body.expect, far=body.far, background=pictures.frames
        ),
        request,
        pictures,
    )
    return DocumentResponse(found.to_dict())
