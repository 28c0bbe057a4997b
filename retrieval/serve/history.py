"""The paths of the history: queries that were answered, touches near a touch, what people said; all of it as a file."""

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
    """A query that was answered. touches: where the gel images of each grasp lie; said, object_id: what a person said
    of it, null before.
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
    """A page of the history, the newest first."""

    total: int
    offset: int
    next: int | None
    items: list[HistoryItem]


class HistoryEntry(HistoryItem):
    """A query with its whole answer."""

    answer: QueryDocument


class NearTouch(HistoryItem):
    """score: inner product of the two mean embeddings, 1 for equal touches."""

    score: float


class NearTouchesDocument(BaseModel):
    """Touches near a touch, the nearest first. compared: how many the same model encoded."""

    id: str
    compared: int
    items: list[NearTouch]


class FeedbackBody(RequestBody):
    """right: the answer was; object: it was the object named; none: it is not in the catalogue."""

    query: str = Field(min_length=1, max_length=64, description="the X-Query-Id of the answer")
    feedback: FeedbackValue
    object_id: str | None = Field(None, min_length=1, max_length=1000)


class FeedbackDocument(BaseModel):
    """What is kept. recorded: whether the grasps are in the recording: the object must have a photo, a grasp must have
    felt something, and the disk must have room. Where it had none, the grasps are recorded after a later feedback, or
    when the service starts again.
    """

    query: str
    feedback: FeedbackValue
    object_id: str | None
    recorded: bool


def _require_history(parts: Service) -> HistoryWriter:
    if parts.history_writer is None:
        raise HttpProblem("unknown", "this service keeps no queries; it was started with --no-history")
    return parts.history_writer


async def _entry(parts: Service, name: str) -> StoredQuery:
    """A query by its id; one that was answered just now is being written."""
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
    search: Annotated[str, Query(max_length=200, description="words of verdict, object and what was said")] = "",
    feedback: Annotated[Literal["right", "object", "none", "missing"] | None, Query()] = None,
) -> HistoryDocument:
    """Queries that were answered, the newest first."""
    history_writer = _require_history(parts)
    await history_writer.drain()
    total, found = await run_in_threadpool(
        lambda: history_writer.store.history(words=search.split()[:20], feedback=feedback, offset=offset, limit=limit)
    )
    end = offset + len(found)
    items = [HistoryItem(**_item(stored)) for stored in found]
    return HistoryDocument(total=total, offset=offset, next=end if offset < end < total else None, items=items)


# What an answer did not say, such as a reference touch, it does not say here either.
@router.get(
    "/v1/history/{name}", responses=problem_responses("unknown", "not-ready"), response_model_exclude_unset=True
)
async def entry(name: str, parts: Parts) -> HistoryEntry:
    """A query with its whole answer."""
    stored = await _entry(parts, name)
    return HistoryEntry(**_item(stored), answer=QueryDocument(**stored.answer))


@router.get(
    "/v1/history/{name}/touches/{grasp}/{finger}",
    response_class=Response,
    responses={**IMAGE_RESPONSES, **problem_responses("unknown", "not-ready")},
)
async def touch(name: str, grasp: int, finger: str, parts: Parts) -> Response:
    """A gel image as it was sent; what browsers do not show, as PNG. grasp: from 1, 0 for the no-contact frames."""
    stored = await _entry(parts, name)
    data = None
    if BACKGROUND <= grasp <= len(stored.answer["query"]["touches"]):
        data = await run_in_threadpool(_require_history(parts).store.picture, name, grasp, finger)
    if data is None:
        raise HttpProblem("unknown", f"the query has no picture of grasp {grasp}, finger {finger[:10]!r}")
    headers = {"cache-control": "private, max-age=86400, immutable"}
    return await run_in_threadpool(image_response, data, headers)


@router.get("/v1/history/{name}/nearest", responses=problem_responses("unknown", "bad-input", "not-ready"))
async def nearest(name: str, parts: Parts, count: Annotated[int, Query(ge=1, le=100)] = 12) -> NearTouchesDocument:
    """Touches of the history that feel to the model like this one."""
    await _entry(parts, name)
    store, model = _require_history(parts).store, parts.generations.current.model
    names, vectors = await run_in_threadpool(store.vectors, model)
    if name not in names:
        raise HttpProblem(
            "bad-input", "another model encoded this touch, or it felt nothing: there is nothing to compare"
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


# What people say ------------------------------------------------------------------------------------------------------


@router.post(
    "/v1/feedback",
    status_code=201,
    responses=problem_responses("unknown", "bad-input", "conflict", "not-ready"),
    openapi_extra=json_body("FeedbackBody"),
)
async def post_feedback(request: Request, parts: Parts, response: Response) -> FeedbackDocument:
    """Say whether an answer was right. When this is answered, what was said outlives the machine; saying the same twice
    is saying it once (200), saying another thing is refused.
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
    except KeyError as error:  # one of the oldest, which went meanwhile
        raise history_writer.missing_query_problem(body.query) from error
    response.status_code = 201 if new else 200
    return FeedbackDocument(query=body.query, feedback=body.feedback, object_id=name, recorded=recorded)


def _resolve_feedback(
    body: FeedbackBody, stored: StoredQuery, generation: ServedGeneration
) -> tuple[str, str | None, bytes | None]:
    """What is kept of a word: what was said, of which object, and its photo. Raises Problem."""
    results = stored.answer["results"]
    if body.feedback == RIGHT:
        if body.object_id is not None:
            raise HttpProblem("bad-input", 'said "right" names no object; say "object" to name one')
        if stored.verdict == NONE_OF_THESE:
            return RIGHT, None, None
        if stored.verdict not in (MATCH, UNCALIBRATED):
            raise HttpProblem("bad-input", f'the answer was "{stored.verdict}", which says nothing of an object')
        return RIGHT, results[0]["object_id"], _read_photo(generation, results[0]["photo"])
    if body.feedback == NONE:
        return NONE, body.object_id, None
    if body.object_id is None:
        raise HttpProblem("bad-input", 'said "object" must name it in object_id')
    shown = next((one["photo"] for one in results if one["object_id"] == body.object_id), None)
    if shown is None:
        rows = generation.shard.page([], body.object_id, 0, 1).rows
        if not rows:
            told = f'the index has no object {body.object_id!r}; say "none" where the catalogue lacks it'
            raise HttpProblem("bad-input", told)
        shown = listed_photo(rows[0]).path
    return OBJECT, body.object_id, _read_photo(generation, shown)


def _read_photo(generation: ServedGeneration, photo: str) -> bytes | None:
    """The file of a catalogue's photo. None where it is gone, or where a gel image stands for a photo: the grasps are
    then kept, but in no recording.
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
    responses={200: {"content": {"application/zip": {}}, "description": "the archive"}, **problem_responses("unknown")},
)
async def export(parts: Parts) -> StreamingResponse:
    """All that is kept, as an archive: `recording/`, which `retrieve train` reads, and `history.jsonl`, a line for each
    query with its answer and what was said.
    """
    history_writer = _require_history(parts)
    await history_writer.drain()
    headers = {"content-disposition": 'attachment; filename="retrieve-history.zip"'}
    return StreamingResponse(_archive(history_writer), media_type="application/zip", headers=headers)


def _archive(history_writer: HistoryWriter) -> Iterator[bytes]:
    """One file after the other, so that memory holds one."""
    sink = _ZipBuffer()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:  # pictures are compressed already
        folder = history_writer.folder / "recording"
        # Lines of metadata come after the images, so that what they name is in the archive.
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
    """A file for `zipfile` to write to, out of which what was written is taken as it comes."""

    def __init__(self) -> None:
        super().__init__()
        self._data = bytearray()

    def writable(self) -> bool:
        """Always: this is what `zipfile` asks."""
        return True

    def write(self, data: Any) -> int:
        """Hold it until it is taken."""
        self._data += data
        return len(data)

    def take(self) -> bytes:
        """All that was written since."""
        data = bytes(self._data)
        self._data.clear()
        return data
