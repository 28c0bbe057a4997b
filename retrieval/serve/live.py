"""Routes of a live rig: sensor pictures, and grasps."""

import base64
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel

from retrieval.serve.errors import HttpProblem
from retrieval.serve.generations import ServedGeneration
from retrieval.serve.service import Parts

router = APIRouter(tags=["live"])
MAX_OBJECT_NAMES = 1000
"""Maximum number of objects among which a random one is chosen for a grasp."""
ObjectParameter = Annotated[str | None, Query(max_length=1000, alias="object", description="Object to grasp.")]


class GraspDocument(BaseModel):
    """Gel images of one grasp of the simulated rig, as PNG files in base64, and the grasped object."""

    object_id: str
    touches: list[str]
    background: list[str] | None


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
