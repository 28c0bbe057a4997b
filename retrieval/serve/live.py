"""Routes of a live rig: sensor pictures, MJPEG streams, and grasps."""

import asyncio
import base64
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import StreamingResponse

from retrieval.serve.documents import GraspDocument
from retrieval.serve.errors import HttpProblem
from retrieval.serve.generations import ServedGeneration
from retrieval.serve.service import Parts, Service

router = APIRouter(tags=["live"])
MAX_OBJECT_NAMES = 1000
"""Maximum number of objects among which a random one is chosen for a grasp."""
BOUNDARY = "picture"
ObjectParameter = Annotated[str | None, Query(max_length=1000, alias="object", description="Object to grasp.")]
Rate = Annotated[float, Query(gt=0, le=30, description="Maximum pictures per second.")]


@router.post("/v1/grasp")
async def grasp(request: Request, parts: Parts, name: ObjectParameter = None) -> GraspDocument:
    """Grasp one of the catalogue's objects: the named one, else a random one.

    The rig makes one grasp at a time.
    """
    close = parts.rig.grasp
    if close is None:
        raise HttpProblem("unknown", "No rig can grasp: neither the catalogue nor --rig is that of the simulated rig.")
    try:
        grasped = await parts.grasps.submit(lambda generation: close(_object_ids(generation, name)), request)
    except HttpProblem:
        raise
    except Exception as error:  # of any rig
        raise HttpProblem("failed", f"The rig could not grasp: {error}") from error
    encoded = [
        [base64.b64encode(data).decode("ascii") for data in images]
        for images in (grasped.touches, grasped.background or [])
    ]
    return GraspDocument(object_id=grasped.object_id, touches=encoded[0], background=encoded[1] or None)


def _object_ids(generation: ServedGeneration, name: str | None) -> list[str]:
    """Return `[name]` if a name is given, else ids of objects spread over the catalogue; raises HttpProblem."""
    shard, photos = generation.shard, generation.searcher.info.photos
    if name is not None:
        if not shard.page([], name, 0, 1).total:
            raise HttpProblem("unknown", f"The index has no object {name!r}. /v1/catalogue lists the objects.")
        return [name]
    step = max(1, photos // MAX_OBJECT_NAMES)
    found = [photo for number in range(0, photos, step) for photo in shard.page([], None, number, 1).photos]
    return sorted({photo.object_id for photo in found})


@router.get(
    "/v1/sensors/{name}/frame",
    response_class=Response,
    responses={
        200: {"content": {"image/jpeg": {}}, "description": "The picture."},
    },
)
async def frame(name: str, request: Request, parts: Parts) -> Response:
    """Return the newest picture of a sensor."""
    return Response(await _read(parts, name, request), media_type="image/jpeg")


@router.get(
    "/v1/sensors/{name}/stream",
    response_class=StreamingResponse,
    responses={
        200: {"content": {"multipart/x-mixed-replace": {}}, "description": "Endless stream of pictures (MJPEG)."},
    },
)
async def stream(name: str, request: Request, parts: Parts, rate: Rate = 10.0) -> StreamingResponse:
    """Stream the pictures of a sensor; an `<img>` element shows them."""
    if parts.streams.locked():
        raise HttpProblem("busy", f"{parts.settings.streams} streams are running already.", {"retry-after": "5"})
    first = await _read(parts, name, request)  # errors are raised before the stream begins
    return StreamingResponse(
        _pictures(parts, name, request, first, 1 / rate), media_type=f"multipart/x-mixed-replace; boundary={BOUNDARY}"
    )


async def _pictures(parts: Service, name: str, request: Request, first: bytes, pause_s: float) -> AsyncIterator[bytes]:
    """Yield the parts of an MJPEG stream until the sensor fails or the service stops."""
    async with parts.streams:
        data: bytes | None = first
        while data is not None and not parts.stopping.is_set():
            yield b"--%b\r\ncontent-type: image/jpeg\r\ncontent-length: %d\r\n\r\n%b\r\n" % (
                BOUNDARY.encode(),
                len(data),
                data,
            )
            await asyncio.sleep(pause_s)
            try:
                data = await _read(parts, name, request)
            except HttpProblem as problem:
                if problem.kind != "busy":
                    data = None  # the sensor failed: end the stream


async def _read(parts: Service, name: str, request: Request) -> bytes:
    read = parts.rig.sensors.get(name)
    if read is None:
        known = ", ".join(sorted(parts.rig.sensors)) or "none; connect a rig with --rig"
        raise HttpProblem("unknown", f"There is no sensor {name[:100]!r}. Known sensors: {known}.")
    try:
        return await parts.frames[name].submit(lambda _: read(), request)
    except HttpProblem:
        raise
    except Exception as error:  # of any driver
        raise HttpProblem("failed", f"Sensor {name}: {error}") from error
