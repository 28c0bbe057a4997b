"""Bodies of requests: how large, how long, and what pictures they hold; all of it before memory is spent.

application/json      {"touches": [["<base64>", "<base64>"], ...], "background": [...], "top": 10, ...}
multipart/form-data   gelsight, once for each image, fingers in their order, grasp after grasp; background; top; ...
"""

import asyncio
import base64
import binascii
from collections.abc import Sequence
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationError, WithJsonSchema
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, UploadFile
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from retrieval.data.images import MAX_PIXELS, picture_size
from retrieval.errors import ImageError
from retrieval.model.posterior import NONE_PRIOR
from retrieval.serve.errors import Problem, invalid
from retrieval.serve.settings import MAX_BODY_BYTES, MAX_BODY_PIXELS, MAX_PICTURES

HELD_BYTES = 4 * MAX_BODY_BYTES
"""Of all bodies that are on their way at once."""
PARSED_AT_ONCE_BYTES = 1 << 18
"""Sooner than a thread begins."""
Body = TypeVar("Body", bound=BaseModel)
MOST_GRASPS, MOST_OBJECTS = 32, 32
_CLOSE = {"connection": "close"}  # what is left of the body is not read


class BodyLimit:
    """Bodies of at most MAX_BODY_BYTES, within `seconds`, and of HELD_BYTES together."""

    def __init__(self, app: ASGIApp, seconds: float) -> None:
        self.app, self.seconds, self.held = app, seconds, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, whose body is refused where it is too large or too slow (ASGI)."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        announced = Headers(scope=scope).get("content-length", "0")
        if announced.isdecimal() and int(announced[:20]) > MAX_BODY_BYTES:
            await too_large().response()(scope, receive, send)
            return
        deadline, received, whole = asyncio.get_running_loop().time() + self.seconds, 0, False

        async def limited() -> Message:
            nonlocal received, whole
            if whole:  # what comes now is the end of the connection
                return await receive()
            try:
                async with asyncio.timeout_at(deadline):
                    message = await receive()
            except TimeoutError:
                raise Problem("too-slow", f"the body must come within {self.seconds:g} s", _CLOSE) from None
            size = len(message.get("body", b""))
            received, self.held = received + size, self.held + size
            if received > MAX_BODY_BYTES:
                raise too_large()
            if self.held > HELD_BYTES:
                raise Problem(
                    "busy", "too many large requests are on their way; try again", _CLOSE | {"retry-after": "1"}
                )
            whole = not message.get("more_body", False)
            return message

        try:
            await self.app(scope, limited, send)
        finally:
            self.held -= received


def too_large() -> Problem:
    """What is answered to a body that is too large."""
    return Problem("too-large", f"a request may hold at most {MAX_BODY_BYTES:,} bytes; send smaller pictures", _CLOSE)


def _decoded(text: Any) -> bytes:
    if not isinstance(text, str):
        raise ValueError("must be a picture's file in base64")
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise ValueError(f"must be a picture's file in base64: {error}") from error


_SCHEMA = {"type": "string", "contentEncoding": "base64", "description": "a picture's file in base64"}
Picture = Annotated[bytes, PlainValidator(_decoded), WithJsonSchema(_SCHEMA)]
Grasps = Annotated[list[Annotated[list[Picture], Field(min_length=1)]], Field(min_length=1, max_length=MOST_GRASPS)]
_PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGNgYGAAAAAEAAH2FzhVAAAAAElFTkSuQmCC"


class Options(BaseModel):
    """What may be said beside the touches; as the options of `retrieve query`."""

    model_config = ConfigDict(extra="forbid")

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

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"touches": [[_PIXEL, _PIXEL]], "top": 3}]}
    )

    touches: Grasps = Field(description="grasps, each with an image for each finger")
    background: list[Picture] | None = Field(None, description="no-contact frames, one for each finger")


class BatchBody(Options):
    """The touches of several objects."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"objects": [[[_PIXEL, _PIXEL]], [[_PIXEL, _PIXEL]]]}]}
    )

    objects: Annotated[list[Grasps], Field(min_length=1, max_length=MOST_OBJECTS)]
    background: list[Picture] | None = Field(None, description="no-contact frames, one for each finger")


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
                    "top": {"type": "integer"},
                    "candidates": {"type": "integer"},
                    "none_prior": {"type": "number"},
                    "deadline_ms": {"type": "number"},
                },
            }
        },
    },
}
"""For OpenAPI: FastAPI cannot say that one path takes two kinds of body."""


def json_body(model: str) -> dict[str, Any]:
    """What OpenAPI says of a path that takes a JSON body of the schema `model`; `retrieval.serve.app` adds the
    schema."""
    schema = {"$ref": f"#/components/schemas/{model}"}
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema}}}}


@dataclass(frozen=True)
class Asked:
    """A query that may be asked: its pictures are of known kinds and sizes; nothing is decoded yet."""

    touches: list[list[bytes]]
    background: list[bytes] | None
    options: Options

    @property
    def keywords(self) -> dict[str, Any]:
        """The keywords of `Searcher.query`, all but the touches."""
        said = self.options
        return {
            "background": self.background,
            "top": said.top,
            "candidates": said.candidates,
            "none_prior": said.none_prior,
        }


async def read_query(request: Request, fingers: int) -> Asked:
    """The query in a request's body, for a model with so many fingers. Raises Problem, ImageError."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind == "multipart/form-data":
        return await _from_form(request, fingers)
    body = await read_json(request, QueryBody)
    check_pictures(body.touches, body.background)
    return Asked(body.touches, body.background, body)


async def read_json(request: Request, model: type[Body]) -> Body:
    """The JSON body of a request, read within its limits; a large one is parsed off the event loop. Raises Problem."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise Problem("unsupported-type", f"the body must be application/json; got {kind[:100] or 'no content-type'}")
    data = await request.body()
    try:
        if len(data) <= PARSED_AT_ONCE_BYTES:
            return model.model_validate_json(data)
        return await run_in_threadpool(model.model_validate_json, data)
    except ValidationError as error:
        wrong = error.errors(include_input=False, include_url=False, include_context=False)
        broken = any(one["type"] == "json_invalid" for one in wrong)
        raise Problem("malformed" if broken else "bad-input", invalid(wrong)) from None


async def _from_form(request: Request, fingers: int) -> Asked:
    await request.body()  # whole before it is parsed: older parsers leave files open where it ends early
    async with request.form(max_files=MAX_PICTURES, max_fields=8, max_part_size=1000) as form:
        pictures: dict[str, list[bytes]] = {"gelsight": [], "background": []}
        said: dict[str, str] = {}
        for name, value in form.multi_items():
            if isinstance(value, UploadFile) != (name in pictures):
                what = "a file" if name in pictures else "a short text"
                raise Problem("bad-input", f"{name[:100]!r} must be {what}, and one of gelsight, background, top, ...")
            if isinstance(value, UploadFile):
                pictures[name].append(await value.read())
            else:
                said[name] = value
    try:
        options = Options.model_validate(said)
    except ValidationError as error:
        raise Problem("bad-input", invalid(error.errors(include_input=False, include_url=False))) from None
    images = pictures["gelsight"]
    if not images or len(images) % fingers:
        raise Problem(
            "bad-input",
            f"this model takes {fingers} gel image(s) for one grasp, so gelsight must be given {fingers} times for "
            f"each grasp; got {len(images)}",
        )
    touches = [images[start : start + fingers] for start in range(0, len(images), fingers)]
    background = pictures["background"] or None
    if len(touches) > MOST_GRASPS:
        raise Problem("bad-input", f"a query may hold at most {MOST_GRASPS} grasps; got {len(touches)}")
    check_pictures(touches, background)
    return Asked(touches, background, options)


def check_pictures(touches: Sequence[Sequence[bytes]], background: Sequence[bytes] | None, of: str = "") -> int:
    """The pixels of all pictures, by their headers. Raises ImageError for what is no picture, and Problem for pictures
    that are too large or too many."""
    named = [
        (f"{of}grasp {number}, finger {_letter(place)}", data)
        for number, grasp in enumerate(touches, start=1)
        for place, data in enumerate(grasp)
    ]
    named += [(f"{of}background of finger {_letter(place)}", data) for place, data in enumerate(background or ())]
    if len(named) > MAX_PICTURES:
        raise Problem("bad-input", f"a request may hold at most {MAX_PICTURES} pictures; got {len(named)}")
    total = 0
    for name, data in named:
        width, height = picture_size(data, name)
        if width * height > MAX_PIXELS:
            raise ImageError(
                name, f"{width} x {height} pixels; at most {MAX_PIXELS:,} are taken: send a smaller picture"
            )
        total += width * height
    if total > MAX_BODY_PIXELS:
        raise Problem(
            "too-large", f"the pictures of a request may have {MAX_BODY_PIXELS:,} pixels together; got {total:,}"
        )
    return total


def _letter(place: int) -> str:
    return ascii_lowercase[place] if place < len(ascii_lowercase) else str(place + 1)
