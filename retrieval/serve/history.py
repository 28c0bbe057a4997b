"""Routes of the history: answered queries, and feedback on them."""

from contextlib import suppress
from datetime import UTC, datetime
from string import ascii_lowercase
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field

from retrieval.data.images import read_bytes
from retrieval.errors import BadInput, ImageError
from retrieval.search.answer import MATCH, NONE_OF_THESE, UNCALIBRATED
from retrieval.search.searcher import Searcher
from retrieval.search.shard import resolve_object
from retrieval.serve.catalogue import IMAGE_RESPONSES, image_response
from retrieval.serve.errors import HttpProblem
from retrieval.serve.service import Parts, Service
from retrieval.serve.store import NONE, OBJECT, RIGHT, HistoryWriter, StoredQuery
from retrieval.serve.uploads import RequestBody

router = APIRouter(tags=["history"])


class FeedbackBody(RequestBody):
    """Feedback on an answer.

    feedback: "right" if the answer is correct, "object" if it is the object in `object_id`, "none" if the object is not
    in the catalogue.
    """

    query: str = Field(min_length=1, max_length=64, description="The X-Query-Id of the answer.")
    feedback: Literal["right", "object", "none"]
    object_id: str | None = Field(None, min_length=1, max_length=1000)


def _require_history(parts: Service) -> HistoryWriter:
    if parts.history_writer is None:
        raise HttpProblem("unknown", "This service stores no queries: it was started with --no-history.")
    return parts.history_writer


def _entry(parts: Service, name: str) -> StoredQuery:
    """Return a query by its id, or raise HttpProblem."""
    stored = _require_history(parts).store.query(name)
    if stored is None:
        raise HttpProblem(
            "unknown",
            f"The history has no query {name[:64]!r}. Of queries without feedback, only the newest are kept.",
        )
    return stored


def _item(request: Request, stored: StoredQuery) -> dict[str, Any]:
    """Return a query without its answer. touches: paths of the gel images of each grasp, relative to the request's."""
    root = "../" * (request.scope["path"].count("/") - 1)  # a proxy may serve this below a prefix
    best = (stored.answer["results"] or [{}])[0]
    touches = [
        [f"{root}v1/history/{stored.id}/touches/{grasp}/{ascii_lowercase[finger]}" for finger in range(len(images))]
        for grasp, images in enumerate(stored.answer["query"]["touches"], start=1)
    ]
    return {
        "id": stored.id,
        "time": datetime.fromtimestamp(stored.time, UTC).isoformat(timespec="milliseconds"),
        "verdict": stored.verdict,
        "best": best.get("object_id"),
        "probability": best.get("probability"),
        "generation": stored.answer["index"]["generation"],
        "touches": touches,
        "feedback": stored.feedback,
        "object_id": stored.object_id,
    }


@router.get("/v1/history")
def history(
    request: Request,
    parts: Parts,
    offset: Annotated[int, Query(ge=0, le=2**31)] = 0,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    search: Annotated[
        str, Query(max_length=200, description="Words of the verdict, the object and the feedback.")
    ] = "",
    feedback: Annotated[Literal["right", "object", "none", "missing"] | None, Query()] = None,
) -> dict[str, Any]:
    """Return one page of the answered queries, the newest first. next: offset of the next page, null at the end."""
    store = _require_history(parts).store
    total, queries = store.history(words=search.split()[:20], feedback=feedback, offset=offset, limit=limit)
    end = offset + len(queries)
    return {
        "total": total,
        "offset": offset,
        "next": end if offset < end < total else None,
        "items": [_item(request, stored) for stored in queries],
    }


@router.get("/v1/history/{name}")
def entry(request: Request, name: str, parts: Parts) -> dict[str, Any]:
    """Return a query with its whole answer, the document of `retrieve query --json`."""
    stored = _entry(parts, name)
    return {**_item(request, stored), "answer": stored.answer}


@router.get("/v1/history/{name}/touches/{grasp}/{finger}", response_class=Response, responses=IMAGE_RESPONSES)
def touch(name: str, grasp: int, finger: str, parts: Parts) -> Response:
    """Return a gel image of a query; formats that browsers lack are converted to PNG.

    grasp: counted from 1; 0 for the no-contact frames.
    """
    data = _require_history(parts).store.pictures(_entry(parts, name).id).get((grasp, finger))
    if data is None:
        raise HttpProblem("unknown", f"The query has no picture of grasp {grasp}, finger {finger[:10]!r}.")
    return image_response(data, {"cache-control": "private, max-age=86400, immutable"})


# Feedback -------------------------------------------------------------------------------------------------------------


@router.post("/v1/feedback", status_code=201)
def post_feedback(body: FeedbackBody, parts: Parts, response: Response) -> dict[str, Any]:
    """Store whether an answer is right.

    The response is sent after the feedback is on the disk. Repeating the same feedback returns 200; different feedback
    on the same query is refused. recorded: whether the grasps are in the recording. This requires a photo of the
    object, a grasp with contact, and room on the disk.
    """
    history_writer = _require_history(parts)
    feedback, name, photo = _resolve_feedback(body, _entry(parts, body.query), parts.generations.current)
    try:
        if not history_writer.store.add_feedback(body.query, feedback, name, photo):
            response.status_code = 200
    except BadInput as error:
        raise HttpProblem("conflict", str(error)) from error
    history_writer.record_pending()
    recorded = history_writer.is_recorded(body.query)
    return {"query": body.query, "feedback": body.feedback, "object_id": name, "recorded": recorded}


def _resolve_feedback(
    body: FeedbackBody, stored: StoredQuery, searcher: Searcher
) -> tuple[str, str | None, bytes | None]:
    """Return the feedback to store, its object and the object's photo; raises HttpProblem."""
    results = stored.answer["results"]
    if body.feedback == RIGHT:
        if body.object_id is not None:
            raise HttpProblem("bad-input", 'Feedback "right" takes no object_id. Send "object" to name an object.')
        if stored.verdict == NONE_OF_THESE:
            return RIGHT, None, None
        if stored.verdict not in (MATCH, UNCALIBRATED):
            raise HttpProblem(
                "bad-input", f'The verdict "{stored.verdict}" names no object, so feedback "right" is not possible.'
            )
        return RIGHT, results[0]["object_id"], _read_photo(searcher, results[0]["photo"])
    if body.feedback == NONE:
        return NONE, body.object_id, None
    if body.object_id is None:
        raise HttpProblem("bad-input", 'Feedback "object" requires object_id.')
    shown = next((match["photo"] for match in results if match["object_id"] == body.object_id), None)
    if shown is None:
        name = resolve_object(searcher.shard, body.object_id)
        photos = searcher.shard.page([], name, 0, 1).photos
        if not photos:
            detail = f'The index has no object {body.object_id!r}. Send "none" if the catalogue lacks the object.'
            raise HttpProblem("bad-input", detail)
        return OBJECT, name, _read_photo(searcher, photos[0].path)
    return OBJECT, body.object_id, _read_photo(searcher, shown)


def _read_photo(searcher: Searcher, photo: str) -> bytes | None:
    """Return the file of a catalogue photo.

    None if the file is gone or has changed, or if the row is a gel image of a reference touch: the feedback is stored,
    not recorded.
    """
    (listed,) = searcher.shard.photos([photo])
    if listed is None or listed.is_touch:
        return None
    with suppress(ImageError):
        return read_bytes(searcher.catalogue / listed.path, listed.digest)
    return None
