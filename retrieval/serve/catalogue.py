"""Routes of the catalogue: pages of photos, search, images, and the index.

The index maps an id to its file. No text of a request becomes part of a file path.
"""

import os
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from retrieval.data.images import read_bytes
from retrieval.data.text import replace_surrogates
from retrieval.errors import ImageError
from retrieval.indexing.enrolled import ENROLLED
from retrieval.report.pages import thumbnail
from retrieval.search.shard import resolve_object
from retrieval.serve.errors import HttpProblem
from retrieval.serve.service import Parts
from retrieval.serve.store import IMAGE_TYPES, as_png_or_jpeg
from retrieval.version import __version__

router = APIRouter(tags=["catalogue"])
IMAGE_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/jpeg": {}, "image/png": {}}, "description": "The picture."}
}
MAX_PHOTO_PX = 4096
"""Maximum longer side, in pixels, of a photo that is converted to JPEG."""
_thumbnail = lru_cache(512)(thumbnail)  # the digest of a photo's content identifies it there


@router.get("/v1/catalogue")
def catalogue(
    parts: Parts,
    offset: Annotated[int, Query(ge=0, le=2**31)] = 0,
    limit: Annotated[int, Query(ge=1, le=500, description="Photos per page.")] = 100,
    search: Annotated[
        str, Query(max_length=200, description="Words that must all occur in the object, the path or the metadata.")
    ] = "",
    name: Annotated[
        str | None, Query(max_length=1000, alias="object", description="Only photos of this object.")
    ] = None,
) -> dict[str, Any]:
    """Return one page of the index's photos, in index order, then the gel images of objects that were only enrolled.

    total: number of matching photos; next: offset of the next page, null at the end; items: `id`, by which all routes
    name the photo, `object_id`, and the user's own `metadata`.
    """
    searcher = parts.generations.current
    name = name and resolve_object(searcher.shard, name)
    page = searcher.shard.page(search.casefold().split(), name, offset, limit)
    end = offset + len(page.photos)
    return {
        "generation": searcher.manifest.generation,
        "total": page.total,
        "offset": offset,
        "next": end if offset < end < page.total else None,
        "items": [
            {"id": photo.path, "object_id": photo.object_id, "metadata": photo.metadata} for photo in page.photos
        ],
    }


@router.get("/v1/photos/{photo:path}", response_class=Response, responses=IMAGE_RESPONSES)
def photo(
    request: Request,
    photo: str,
    parts: Parts,
    px: Annotated[int | None, Query(ge=32, le=1024, description="Pixels of the longer side of a small JPEG.")] = None,
) -> Response:
    """Return a photo or a reference gel image: its file, or a small JPEG if `px` is given.

    Formats that browsers lack are converted to JPEG.
    """
    searcher = parts.generations.current
    (listed,) = searcher.shard.photos([photo])
    if listed is None:
        raise HttpProblem("unknown", f"The index has no photo {photo!r}. /v1/catalogue lists the photos.")
    headers = {"etag": f'"{listed.digest}-{px}"', "cache-control": "private, no-cache"}
    if request.headers.get("if-none-match") == headers["etag"]:
        return Response(status_code=304, headers=headers)
    path = searcher.picture_file(listed)
    try:
        data = read_bytes(path, listed.digest) if px is None else b""
        if not data.startswith(tuple(IMAGE_TYPES)):
            data = _thumbnail(path, px or MAX_PHOTO_PX, listed.digest)
    except ImageError as error:
        detail = f"The photo {photo!r} cannot be shown: {error.reason}. Run `retrieve build-index` again."
        raise HttpProblem("unknown", detail) from error
    return image_response(data, headers)


def image_response(data: bytes, headers: Mapping[str, str] | None = None) -> Response:
    """Return an image file as a response, as PNG or JPEG. Raises ImageError if it cannot be decoded."""
    data = as_png_or_jpeg(data)
    kind = next(kind for magic, kind in IMAGE_TYPES.items() if data.startswith(magic))
    return Response(data, media_type=kind, headers=headers)


def is_writable(index: Path) -> bool:
    """Return whether the service may write enrolled touches to this folder."""
    folder = index / ENROLLED
    return os.access(folder if folder.exists() else index, os.W_OK)


@router.get("/v1/index")
def index(parts: Parts) -> dict[str, Any]:
    """Return a description of the index, its model and the service.

    sensors: names of live sensors; can_grasp, can_verify: whether POST /v1/grasp and POST /v1/verify work;
    can_enrol: whether touches can be enrolled; stores_history: whether queries and feedback are stored. objects
    includes those that have enrolled touches only.
    """
    searcher = parts.generations.current
    info, (objects, enrolled) = searcher.manifest, searcher.shard.counts()
    return {
        "generation": searcher.manifest.generation,
        "kind": info.kind,
        "photos": info.photos,
        "objects": objects,
        "enrolled_touches": enrolled,
        "model": replace_surrogates(searcher.checkpoint.path.name),
        "trained_on": replace_surrogates(str(searcher.checkpoint.provenance.get("source", "unknown"))),
        "fingers": searcher.reader.fingers,
        "background": searcher.checkpoint.config.preprocessing.background,
        "sensors": sorted(parts.rig.sensors),
        "can_grasp": parts.rig.grasp is not None,
        "can_verify": searcher.can_verify,
        "can_enrol": searcher.can_enrol and is_writable(searcher.index),
        "stores_history": parts.history_writer is not None,
        "version": __version__,
    }
