"""Routes of queries, of verification, of enrolment, and of a live rig: sensor pictures and grasps."""

import base64
import random
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field

from retrieval.errors import BadInput
from retrieval.indexing.enrolled import content_digest, remove_enrolled
from retrieval.search.searcher import Searcher
from retrieval.search.shard import resolve_object
from retrieval.serve.catalogue import is_writable
from retrieval.serve.errors import DocumentResponse, HttpProblem
from retrieval.serve.service import Parts, Service
from retrieval.serve.uploads import (
    MAX_GRASPS,
    Base64Image,
    Grasps,
    Openings,
    QueryBody,
    RequestBody,
    RequestPictures,
    json_body,
    read_json,
)

router = APIRouter()


@router.post(
    "/v1/query",
    tags=["queries"],
    response_model=dict[str, Any],
    openapi_extra=json_body(QueryBody),
    summary="Which object is in the hand?",
)
async def query(request: Request, parts: Parts) -> DocumentResponse:
    """Return the document of `retrieve query --json` for one or several grasps of one object."""
    parts.queue.require_capacity()
    body = await read_json(request, QueryBody)
    pictures = RequestPictures(body.touches, body.background)
    options = body.model_dump(exclude={"touches", "background"})
    result = await parts.queue.submit(
        lambda searcher: searcher.query(pictures.images, background=pictures.frames, **options),
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
    tags=["queries"],
    response_model=dict[str, Any],
    openapi_extra=json_body(VerifyBody),
    summary="Is the expected object in the hand?",
)
async def verify(request: Request, parts: Parts) -> DocumentResponse:
    """Return the document of `retrieve verify --json`."""
    parts.queue.require_capacity()
    body = await read_json(request, VerifyBody)
    pictures = RequestPictures(body.touches, body.background)
    decision = await parts.queue.submit(
        lambda searcher: searcher.verify(pictures.images, body.expect, far=body.far, background=pictures.frames),
        request,
        pictures,
    )
    return DocumentResponse(decision.to_dict())


# Enrolment ------------------------------------------------------------------------------------------------------------


class EnrolBody(RequestBody):
    """Touches of one object."""

    touches: Grasps
    background: list[Base64Image] | None = None
    opening_mm: Openings = None


@router.post(
    "/v1/objects/{name:path}/touches",
    tags=["catalogue"],
    status_code=201,
    openapi_extra=json_body(EnrolBody),
    summary="Remember touches of an object",
)
async def enrol(name: str, request: Request, parts: Parts) -> dict[str, Any]:
    """Enrol touches of an object of the index, or of a new one; the next answer uses them.

    touches: number of the object's enrolled touches; added: an id of each new one, by which DELETE removes it.
    """
    parts.queue.require_capacity()
    _require_writable(parts)
    body = await read_json(request, EnrolBody)
    pictures = RequestPictures(body.touches, body.background)
    enrolment = await parts.queue.submit(
        lambda searcher: searcher.enrol(name, pictures.images, opening_mm=body.opening_mm, background=pictures.frames),
        request,
        pictures,
    )
    added = [content_digest(grasp[0]) for grasp in body.touches]
    return {"object_id": enrolment.object_id, "touches": enrolment.touches, "added": added}


@router.delete("/v1/objects/{name:path}/touches", tags=["catalogue"], summary="Forget enrolled touches of an object")
async def forget(
    name: str,
    request: Request,
    parts: Parts,
    touch: Annotated[list[str] | None, Query(max_length=MAX_GRASPS, description="Ids of touches; all if none.")] = None,
) -> dict[str, Any]:
    """Remove enrolled touches of an object; the photos and reference touches of the catalogue stay."""
    _require_writable(parts)
    try:
        object_id, removed = await parts.queue.submit(
            lambda searcher: remove_enrolled(searcher.index, name, pictures=touch), request
        )
    except BadInput as error:
        raise HttpProblem("unknown", str(error)) from error
    return {"object_id": object_id, "removed": removed}


def _require_writable(parts: Service) -> None:
    folder = parts.settings.index
    if not is_writable(folder):
        raise HttpProblem("refused", f"The service may not write to {folder}, so it cannot change enrolled touches.")


# Live rig -------------------------------------------------------------------------------------------------------------

DRAWN_PHOTOS = 20
"""Number of random photos of whose objects one is grasped."""


@router.post("/v1/grasp", tags=["live"])
async def grasp(
    request: Request,
    parts: Parts,
    name: Annotated[str | None, Query(max_length=1000, alias="object", description="Object to grasp.")] = None,
) -> dict[str, Any]:
    """Grasp one of the catalogue's objects: the named one, else a random one.

    The rig makes one grasp at a time. touches, background: a PNG file in base64 for each finger; object_id: the object;
    opening_mm: the opening of the jaws, null if the gripper does not measure it.
    """
    close = parts.rig.grasp
    if close is None:
        raise HttpProblem("unknown", "No rig can grasp: neither the catalogue nor --rig is that of the simulated rig.")
    try:
        grasped = await parts.grasps.submit(lambda searcher: close(_object_ids(searcher, name)), request)
    except HttpProblem:
        raise
    except Exception as error:  # of any rig
        raise HttpProblem("failed", f"The rig could not grasp: {error}") from error

    def encoded(images: list[bytes]) -> list[str]:
        return [base64.b64encode(data).decode("ascii") for data in images]

    return {
        "object_id": grasped.object_id,
        "touches": encoded(grasped.touches),
        "background": grasped.background and encoded(grasped.background),
        "opening_mm": grasped.opening_mm,
    }


def _object_ids(searcher: Searcher, name: str | None) -> list[str]:
    """Return `[name]` if a name is given, else the objects of random photos; raises HttpProblem."""
    shard = searcher.shard
    if name is not None:
        name = resolve_object(shard, name)
        if not shard.page([], name, 0, 1).total:
            raise HttpProblem("unknown", f"The index has no object {name!r}. /v1/catalogue lists the objects.")
        return [name]
    drawn = (random.randrange(searcher.manifest.photos) for _ in range(DRAWN_PHOTOS))
    return [photo.object_id for number in drawn for photo in shard.page([], None, number, 1).photos]


@router.get(
    "/v1/sensors/{name}/frame",
    tags=["live"],
    response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}, "description": "The picture."}},
)
async def frame(name: str, request: Request, parts: Parts) -> Response:
    """Return the newest picture of a sensor."""
    read = parts.rig.sensors.get(name)
    if read is None:
        known = ", ".join(sorted(parts.rig.sensors)) or "none; connect a rig with --rig"
        raise HttpProblem("unknown", f"There is no sensor {name[:100]!r}. Known sensors: {known}.")
    try:
        return Response(await parts.frames[name].submit(lambda _: read(), request), media_type="image/jpeg")
    except HttpProblem:
        raise
    except Exception as error:  # of any driver
        raise HttpProblem("failed", f"Sensor {name}: {error}") from error
