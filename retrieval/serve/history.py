"""Routes of the history: answered queries, similar touches, feedback, and an export of everything."""

import asyncio
import io
import json
import zipfile
from collections.abc import Iterator
from datetime import UTC, datetime
from string import ascii_lowercase
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool

from retrieval.data.images import read_bytes
from retrieval.errors import BadInput, ImageError
from retrieval.search.query.answer import MATCH, NONE_OF_THESE, UNCALIBRATED
from retrieval.search.query.objects import listed_photo
from retrieval.serve.catalogue import IMAGE_RESPONSES, image_response
from retrieval.serve.documents import QueryDocument
from retrieval.serve.errors import HttpProblem, problem_responses
from retrieval.serve.generations import ServedGeneration
from retrieval.serve.service import HistoryWriter, Parts, Service
from retrieval.serve.store import BACKGROUND, NONE, OBJECT, RIGHT, StoredQuery
from retrieval.serve.uploads import RequestBody, json_body, read_json

router = APIRouter(tags=["history"])
FeedbackValue = Literal["right", "object", "none"]


class HistoryItem(BaseModel):
    """An answered query.

    touches: paths of the gel images of each grasp; feedback, object_id: feedback of a person, null if there is none.
    """

    id: str
    time: str
    verdict: str
    best: str | None
    probability: float | None
    generation: str
    touches: list[list[str]]
    feedback: FeedbackValue | None
    object_id: str | None


class HistoryDocument(BaseModel):
    """One page of the history, the newest query first."""

    total: int
    offset: int
    next: int | None
    items: list[HistoryItem]


class HistoryEntry(HistoryItem):
    """A query with its whole answer."""

    answer: QueryDocument


class NearTouch(HistoryItem):
    """A similar touch. score: inner product of the two mean embeddings, 1 for equal touches."""

    score: float


class NearTouchesDocument(BaseModel):
    """Touches similar to a touch, the most similar first. compared: number of touches that the same model encoded."""

    id: str
    compared: int
    items: list[NearTouch]


class FeedbackBody(RequestBody):
    """Feedback on an answer.

    feedback: "right" if the answer is correct, "object" if it is the object in `object_id`, "none" if the object is not
    in the catalogue.
    """

    query: str = Field(min_length=1, max_length=64, description="The X-Query-Id of the answer.")
    feedback: FeedbackValue
    object_id: str | None = Field(None, min_length=1, max_length=1000)


class FeedbackDocument(BaseModel):
    """The stored feedback.

    recorded: whether the grasps are in the recording. This requires a photo of the object, a grasp with contact, and
    room on the disk. If the disk is full, the grasps are recorded after a later feedback or at the next start.
    """

    query: str
    feedback: FeedbackValue
    object_id: str | None
    recorded: bool


def _require_history(parts: Service) -> HistoryWriter:
    if parts.history_writer is None:
        raise HttpProblem("unknown", "This service stores no queries: it was started with --no-history.")
    return parts.history_writer


async def _entry(parts: Service, name: str) -> StoredQuery:
    """Return a query by its id, after pending queries are written; raises HttpProblem if it is missing."""
    history_writer = _require_history(parts)
    await history_writer.drain()
    stored = await run_in_threadpool(history_writer.store.query, name)
    if stored is None:
        raise history_writer.missing_query_problem(name)
    return stored


def _item(stored: StoredQuery) -> dict[str, Any]:
    best = (stored.answer["results"] or [{}])[0]
    touches = [
        [f"/v1/history/{stored.id}/touches/{grasp}/{ascii_lowercase[finger]}" for finger in range(len(images))]
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


@router.get("/v1/history", responses=problem_responses("unknown", "bad-input"))
async def history(
    parts: Parts,
    offset: Annotated[int, Query(ge=0, le=2**31)] = 0,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    search: Annotated[
        str, Query(max_length=200, description="Words of the verdict, the object and the feedback.")
    ] = "",
    feedback: Annotated[Literal["right", "object", "none", "missing"] | None, Query()] = None,
) -> HistoryDocument:
    """Return one page of the answered queries, the newest first."""
    history_writer = _require_history(parts)
    await history_writer.drain()
    total, found = await run_in_threadpool(
        lambda: history_writer.store.history(words=search.split()[:20], feedback=feedback, offset=offset, limit=limit)
    )
    end = offset + len(found)
    items = [HistoryItem(**_item(stored)) for stored in found]
    return HistoryDocument(total=total, offset=offset, next=end if offset < end < total else None, items=items)


# Fields that the original answer lacks, such as a reference touch, stay absent.
@router.get(
    "/v1/history/{name}", responses=problem_responses("unknown", "not-ready"), response_model_exclude_unset=True
)
async def entry(name: str, parts: Parts) -> HistoryEntry:
    """Return a query with its whole answer."""
    stored = await _entry(parts, name)
    return HistoryEntry(**_item(stored), answer=QueryDocument(**stored.answer))


@router.get(
    "/v1/history/{name}/touches/{grasp}/{finger}",
    response_class=Response,
    responses={**IMAGE_RESPONSES, **problem_responses("unknown", "not-ready")},
)
async def touch(name: str, grasp: int, finger: str, parts: Parts) -> Response:
    """Return a gel image of a query; formats that browsers lack are converted to PNG.

    grasp: counted from 1; 0 for the no-contact frames.
    """
    stored = await _entry(parts, name)
    data = None
    if BACKGROUND <= grasp <= len(stored.answer["query"]["touches"]):
        data = await run_in_threadpool(_require_history(parts).store.picture, name, grasp, finger)
    if data is None:
        raise HttpProblem("unknown", f"The query has no picture of grasp {grasp}, finger {finger[:10]!r}.")
    headers = {"cache-control": "private, max-age=86400, immutable"}
    return await run_in_threadpool(image_response, data, headers)


@router.get("/v1/history/{name}/nearest", responses=problem_responses("unknown", "bad-input", "not-ready"))
async def nearest(name: str, parts: Parts, count: Annotated[int, Query(ge=1, le=100)] = 12) -> NearTouchesDocument:
    """Return the touches of the history that are most similar to this one, by the model's embeddings."""
    await _entry(parts, name)
    store, model = _require_history(parts).store, parts.generations.current.model
    names, vectors = await run_in_threadpool(store.vectors, model)
    if name not in names:
        raise HttpProblem(
            "bad-input",
            "This touch has no embedding of the current model: another model encoded it, or it has no contact.",
        )
    own = names.index(name)
    scores = vectors @ vectors[own]
    order = [place for place in np.lexsort((names, -scores)).tolist() if place != own][:count]
    items = []
    for place in order:
        stored = await run_in_threadpool(store.query, names[place])
        if stored is not None:
            items.append(NearTouch(**_item(stored), score=float(scores[place])))
    return NearTouchesDocument(id=name, compared=len(names), items=items)


# Feedback -------------------------------------------------------------------------------------------------------------


@router.post(
    "/v1/feedback",
    status_code=201,
    responses=problem_responses("unknown", "bad-input", "conflict", "not-ready"),
    openapi_extra=json_body("FeedbackBody"),
)
async def post_feedback(request: Request, parts: Parts, response: Response) -> FeedbackDocument:
    """Store whether an answer is right.

    The response is sent after the feedback is on the disk. Repeating the same feedback returns 200; different feedback
    on the same query is refused.
    """
    body = await read_json(request, FeedbackBody)
    stored = await _entry(parts, body.query)
    history_writer, generation = _require_history(parts), parts.generations.current

    def add_feedback() -> tuple[bool, bool, str | None]:
        feedback, name, photo = _resolve_feedback(body, stored, generation)
        new = history_writer.store.add_feedback(body.query, feedback, name, photo)
        history_writer.recording.record_pending()
        return new, history_writer.recording.contains(body.query), name

    try:
        new, recorded, name = await asyncio.shield(asyncio.to_thread(add_feedback))
    except BadInput as error:
        raise HttpProblem("conflict", str(error)) from error
    except KeyError as error:  # the query was deleted in the meantime
        raise history_writer.missing_query_problem(body.query) from error
    response.status_code = 201 if new else 200
    return FeedbackDocument(query=body.query, feedback=body.feedback, object_id=name, recorded=recorded)


def _resolve_feedback(
    body: FeedbackBody, stored: StoredQuery, generation: ServedGeneration
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
        return RIGHT, results[0]["object_id"], _read_photo(generation, results[0]["photo"])
    if body.feedback == NONE:
        return NONE, body.object_id, None
    if body.object_id is None:
        raise HttpProblem("bad-input", 'Feedback "object" requires object_id.')
    shown = next((one["photo"] for one in results if one["object_id"] == body.object_id), None)
    if shown is None:
        rows = generation.shard.page([], body.object_id, 0, 1).rows
        if not rows:
            detail = f'The index has no object {body.object_id!r}. Send "none" if the catalogue lacks the object.'
            raise HttpProblem("bad-input", detail)
        shown = listed_photo(rows[0]).path
    return OBJECT, body.object_id, _read_photo(generation, shown)


def _read_photo(generation: ServedGeneration, photo: str) -> bytes | None:
    """Return the file of a catalogue photo.

    None if the file is gone, or if the row is a gel image of a reference touch: the feedback is stored, not recorded.
    """
    (row,) = generation.shard.rows([photo])
    try:
        return (
            None
            if row is None or row.get("touch")
            else read_bytes(generation.searcher.catalogue / listed_photo(row).path)
        )
    except ImageError:
        return None


# Export ---------------------------------------------------------------------------------------------------------------


@router.get(
    "/v1/export.zip",
    response_class=StreamingResponse,
    responses={
        200: {"content": {"application/zip": {}}, "description": "The archive."},
        **problem_responses("unknown"),
    },
)
async def export(parts: Parts) -> StreamingResponse:
    """Return the whole history as a ZIP archive.

    It contains `recording/`, which `retrieve train` reads, and `history.jsonl`, one line for each query with its answer
    and feedback.
    """
    history_writer = _require_history(parts)
    await history_writer.drain()
    headers = {"content-disposition": 'attachment; filename="retrieve-history.zip"'}
    return StreamingResponse(_archive(history_writer), media_type="application/zip", headers=headers)


def _archive(history_writer: HistoryWriter) -> Iterator[bytes]:
    """Yield the archive file by file, so that memory contains one file at a time."""
    sink = _ZipBuffer()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:  # pictures are compressed already
        folder = history_writer.folder / "recording"
        # The metadata comes after the images, so that the archive contains all images that it names.
        for path in (folder / "recording.json", *sorted((folder / "images").glob("*.*")), folder / "metadata.jsonl"):
            if path.is_file() and path.suffix != ".part":
                archive.write(path, f"recording/{path.relative_to(folder)}")
                yield sink.take()
        with archive.open("history.jsonl", "w", force_zip64=True) as lines:
            for name in history_writer.store.names():
                if (stored := history_writer.store.query(name)) is not None:
                    lines.write(json.dumps({**_item(stored), "answer": stored.answer}).encode() + b"\n")
                    yield sink.take()
    yield sink.take()


class _ZipBuffer(io.RawIOBase):
    """Write-only file for `zipfile` whose content can be taken while it is written."""

    def __init__(self) -> None:
        super().__init__()
        self._data = bytearray()

    def writable(self) -> bool:
        """Return True; `zipfile` requires it."""
        return True

    def write(self, data: Any) -> int:
        """Append data to the buffer."""
        self._data += data
        return len(data)

    def take(self) -> bytes:
        """Return the data written since the last call, and clear the buffer."""
        data = bytes(self._data)
        self._data.clear()
        return data
