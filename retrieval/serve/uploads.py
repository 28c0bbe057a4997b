"""Bodies of requests: how large, how long, and what pictures they hold; all of it before memory is spent.

application/json      {"touches": [["<base64>", "<base64>"], ...], "background": [...], "top": 10, ...}
multipart/form-data   gelsight, once for each image, fingers in their order, grasp after grasp; background; top; ...
"""

import asyncio
import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from string import ascii_lowercase
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationError, WithJsonSchema
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from retrieval.model.gel_images import GelImage
from retrieval.model.posterior import NONE_PRIOR
from retrieval.serve.errors import HttpProblem, validation_message
from retrieval.serve.forms import form_parts
from retrieval.serve.settings import MAX_BODY_BYTES, MAX_PICTURES, MAX_SMALL_BODY_BYTES

PICTURE_PATHS = frozenset({"/v1/query", "/v1/query/batch", "/v1/query/cumulative", "/v1/agreement"})
"""Whose bodies hold pictures, and may have MAX_BODY_BYTES; all others have MAX_SMALL_BODY_BYTES."""
LARGE_BYTES = 1_000_000
"""A body with more is a large one."""
MAX_LARGE_BODIES = 2
"""At once."""
MAX_SMALL_BODIES_BYTES = 20_000_000
"""Of all other bodies together."""
MAX_INLINE_PARSE_BYTES = 1 << 18
"""Sooner than a thread begins."""
MAX_JSON_VALUES = 2_000
"""In one body: MAX_PICTURES in lists of their own, of objects of their own, and the options make fewer than 800."""
MAX_FIELD_BYTES = 1000
"""Of an option in a form."""
Body = TypeVar("Body", bound=BaseModel)
MAX_GRASPS, MAX_OBJECTS = 32, 32
_CLOSE = {"connection": "close"}  # what is left of the body is not read
_CLOSE_AND_RETRY = _CLOSE | {"retry-after": "1"}


class BodyLimit:
    """Bodies as large as their path takes, within `seconds`, MAX_LARGE_BODIES at once, the others of HELD_BYTES
    together.
    """

    def __init__(self, app: ASGIApp, seconds: float) -> None:
        self.app, self.seconds, self.held_bytes, self.large_bodies = app, seconds, 0, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, whose body is refused where it is too large or too slow (ASGI)."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        max_bytes = MAX_BODY_BYTES if scope["path"] in PICTURE_PATHS else MAX_SMALL_BODY_BYTES
        announced = Headers(scope=scope).get("content-length", "0")
        if announced.isdecimal() and int(announced[:20]) > max_bytes:
            await too_large(max_bytes).response()(scope, receive, send)
            return
        deadline, received, held_bytes = asyncio.get_running_loop().time() + self.seconds, 0, 0
        whole = is_large = False

        async def limited() -> Message:
            nonlocal received, held_bytes, whole, is_large
            if whole:  # what comes now is the end of the connection
                return await receive()
            try:
                async with asyncio.timeout_at(deadline):
                    message = await receive()
            except TimeoutError:
                raise HttpProblem("too-slow", f"the body must come within {self.seconds:g} s", _CLOSE) from None
            size = len(message.get("body", b""))
            received += size
            if received > max_bytes:
                raise too_large(max_bytes)
            if received <= LARGE_BYTES:
                held_bytes, self.held_bytes = received, self.held_bytes + size
                if self.held_bytes > MAX_SMALL_BODIES_BYTES:
                    raise HttpProblem("busy", "too many requests are on their way; try again", _CLOSE_AND_RETRY)
            elif not is_large:
                if self.large_bodies >= MAX_LARGE_BODIES:
                    raise HttpProblem("busy", "too many large requests are on their way; try again", _CLOSE_AND_RETRY)
                is_large, self.large_bodies = True, self.large_bodies + 1
                held_bytes, self.held_bytes = 0, self.held_bytes - held_bytes
            whole = not message.get("more_body", False)
            return message

        try:
            await self.app(scope, limited, send)
        finally:
            self.large_bodies -= is_large
            self.held_bytes -= held_bytes


def too_large(max_bytes: int) -> HttpProblem:
    """What is answered to a body of more than `max_bytes` bytes."""
    advice = "; send smaller pictures" if max_bytes == MAX_BODY_BYTES else ""
    return HttpProblem("too-large", f"a request to this path may hold at most {max_bytes:,} bytes{advice}", _CLOSE)


def _decoded(text: Any) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (TypeError, ValueError) as error:
        raise ValueError(f"must be a picture's file in base64: {error}") from error


_SCHEMA = {"type": "string", "contentEncoding": "base64", "description": "a picture's file in base64"}
Base64Image = Annotated[bytes, PlainValidator(_decoded), WithJsonSchema(_SCHEMA)]
Grasps = Annotated[list[Annotated[list[Base64Image], Field(min_length=1)]], Field(min_length=1, max_length=MAX_GRASPS)]
_PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGNgYGAAAAAEAAH2FzhVAAAAAElFTkSuQmCC"


class RequestBody(BaseModel):
    """A JSON body; other keys than those of its model are refused."""

    model_config = ConfigDict(extra="forbid")


class Options(RequestBody):
    """Options of a query besides the touches, as those of `retrieve query`."""

    top: int = Field(10, ge=1, le=1000, description="objects to return")
    candidates: int | None = Field(
        None, ge=1, le=10_000_000, description="photos that the full classifier judges; null: what the index needs"
    )
    none_prior: float = Field(
        NONE_PRIOR, gt=0, lt=1, description="probability, before anything is felt, that the catalogue lacks the object"
    )
    deadline_ms: float | None = Field(
        None, gt=0, le=3_600_000, description="after which no answer is wanted; the service's own deadline holds too"
    )


class QueryBody(Options):
    """The touches of one object."""

    model_config = {"json_schema_extra": {"examples": [{"touches": [[_PIXEL, _PIXEL]], "top": 3}]}}

    touches: Grasps = Field(description="grasps, each with an image for each finger")
    background: list[Base64Image] | None = Field(None, description="no-contact frames, one for each finger")


class BatchBody(Options):
    """The touches of several objects."""

    model_config = {"json_schema_extra": {"examples": [{"objects": [[[_PIXEL, _PIXEL]], [[_PIXEL, _PIXEL]]]}]}}

    objects: Annotated[list[Grasps], Field(min_length=1, max_length=MAX_OBJECTS)]
    background: list[Base64Image] | None = Field(None, description="no-contact frames, one for each finger")


QUERY_BODY = {
    "required": True,
    "content": {
        "application/json": {"schema": {"$ref": "#/components/schemas/QueryBody"}},
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["gelsight"],
                "properties": {
                    "gelsight": {
                        "type": "array",
                        "items": {"type": "string", "format": "binary"},
                        "description": "gel images: the fingers of a grasp in their order, grasp after grasp",
                    },
                    "background": {"type": "array", "items": {"type": "string", "format": "binary"}},
                    **Options.model_json_schema()["properties"],
                },
            }
        },
    },
}
"""For OpenAPI: FastAPI cannot say that one path takes two kinds of body."""


def json_body(model: str) -> dict[str, Any]:
    """What OpenAPI says of a path that takes a JSON body of the schema `model`; `retrieval.serve.app` adds the
    schema.
    """
    schema = {"$ref": f"#/components/schemas/{model}"}
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema}}}}


@dataclass(eq=False)
class RequestPictures:
    """The files of a request's pictures, and what the matcher looks at of them, once `Queue.submit` had them read.

    files: for each object its grasps, for each grasp a file for each finger. background: the fingers' no-contact
    frames. is_batch: whether messages name the object. images, frames: the same, read.
    """

    files: Sequence[Sequence[Sequence[bytes]]]
    background: Sequence[bytes] | None
    is_batch: bool = False
    images: list[list[list[GelImage]]] = field(default_factory=list)
    frames: list[GelImage] | None = None

    def named_files(self) -> list[tuple[str, bytes]]:
        """Each file, and how messages and answers call it."""
        found = [
            (f"{f'object {at}, ' if self.is_batch else ''}grasp {number}, finger {_letter(place)}", data)
            for at, grasps in enumerate(self.files, start=1)
            for number, grasp in enumerate(grasps, start=1)
            for place, data in enumerate(grasp)
        ]
        found += [(f"background of finger {_letter(place)}", data) for place, data in enumerate(self.background or ())]
        return found

    def set_images(self, images: Iterator[GelImage]) -> None:
        """Take the read images, in the order of `named_files`."""
        self.images = [[[next(images) for _ in grasp] for grasp in grasps] for grasps in self.files]
        self.frames = None if self.background is None else list(images)


@dataclass(frozen=True)
class ParsedQuery:
    """A query that may be asked; its pictures are still to be read."""

    pictures: RequestPictures
    options: Options

    @property
    def keywords(self) -> dict[str, Any]:
        """The keywords of `Searcher.query`, all but the touches; the pictures must have been read."""
        options = self.options.model_dump(include={"top", "candidates", "none_prior"})
        return {"background": self.pictures.frames, **options}

    def can_batch_with(self, other: "ParsedQuery") -> bool:
        """Whether both can be answered together."""
        background = self.pictures.background == other.pictures.background
        return background and {**self.keywords, "background": None} == {**other.keywords, "background": None}


def pictures_of(
    objects: Sequence[Sequence[Sequence[bytes]]], background: Sequence[bytes] | None, is_batch: bool = False
) -> RequestPictures:
    """The pictures of a request. Raises Problem where there are too many."""
    count = sum(len(grasp) for grasps in objects for grasp in grasps) + len(background or ())
    if count > MAX_PICTURES:
        raise HttpProblem("bad-input", f"a request may hold at most {MAX_PICTURES} pictures; got {count}")
    return RequestPictures(objects, background, is_batch)


async def read_query(request: Request, fingers: int) -> ParsedQuery:
    """The query in a request's body, for a model with so many fingers. Raises Problem."""
    if _content_type(request) == "multipart/form-data":
        data = await _body_of(request)
        return await run_in_threadpool(_from_form, data, request.headers["content-type"], fingers)
    body = await read_json(request, QueryBody)
    return ParsedQuery(pictures_of([body.touches], body.background), body)


async def read_json(request: Request, model: type[Body]) -> Body:
    """The JSON body of a request, read within its limits; a large one is parsed off the event loop. Raises Problem."""
    kind = _content_type(request)
    if kind != "application/json":
        raise HttpProblem(
            "unsupported-type", f"the body must be application/json; got {kind[:100] or 'no content-type'}"
        )
    data = await _body_of(request)
    try:
        if len(data) <= MAX_INLINE_PARSE_BYTES:
            return _parsed(data, model)
        return await run_in_threadpool(_parsed, data, model)
    except ValidationError as error:
        wrong = error.errors(include_input=False, include_url=False, include_context=False)
        broken = any(one["type"] == "json_invalid" for one in wrong)
        raise HttpProblem("malformed" if broken else "bad-input", validation_message(wrong)) from None


def _content_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def _body_of(request: Request) -> bytes:
    """The whole body, which the request does not keep."""
    return b"".join([chunk async for chunk in request.stream()])


def _parsed(data: bytes, model: type[Body]) -> Body:
    """The body, made when it cannot hold more values than MAX_JSON_VALUES: each but the first follows one of `,:[{`,
    which base64 has not. Raises Problem and ValidationError.
    """
    values = 1 + sum(map(data.count, (b",", b":", b"[", b"{")))
    if values > MAX_JSON_VALUES:
        raise HttpProblem("bad-input", f"a body may hold at most {MAX_JSON_VALUES:,} JSON values; got up to {values:,}")
    return model.model_validate_json(data)


def _from_form(data: bytes, content_type: str, fingers: int) -> ParsedQuery:
    files: dict[str, list[bytes]] = {"gelsight": [], "background": []}
    said: dict[str, str] = {}
    for name, is_file, content in form_parts(data, content_type):
        if is_file != (name in files) or (not is_file and len(content) > MAX_FIELD_BYTES):
            what = "a file" if name in files else "a short text"
            raise HttpProblem("bad-input", f"{name[:100]!r} must be {what}, and one of gelsight, background, top, ...")
        if is_file:
            files[name].append(content)
        else:
            said[name] = content.decode("utf-8", "replace")
    try:
        options = Options.model_validate(said)
    except ValidationError as error:
        raise HttpProblem(
            "bad-input", validation_message(error.errors(include_input=False, include_url=False))
        ) from None
    images = files["gelsight"]
    if not images or len(images) % fingers:
        raise HttpProblem(
            "bad-input",
            f"this model takes {fingers} gel image(s) for one grasp, so gelsight must be given {fingers} times for "
            f"each grasp; got {len(images)}",
        )
    touches = [images[start : start + fingers] for start in range(0, len(images), fingers)]
    if len(touches) > MAX_GRASPS:
        raise HttpProblem("bad-input", f"a query may hold at most {MAX_GRASPS} grasps; got {len(touches)}")
    return ParsedQuery(pictures_of([touches], files["background"] or None), options)


def _letter(place: int) -> str:
    return ascii_lowercase[place] if place < len(ascii_lowercase) else str(place + 1)
