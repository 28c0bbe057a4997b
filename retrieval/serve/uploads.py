"""Parsing of request bodies, and limits on their size and time. The limits apply before memory is used.

{"touches": [["<base64>", "<base64>"], ...], "background": [...], "opening_mm": [...], ...}
"""

import asyncio
import base64
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from string import ascii_lowercase
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationError, WithJsonSchema
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from retrieval.model.posterior import NONE_PRIOR
from retrieval.model.touches import GelImage
from retrieval.serve.errors import HttpProblem, validation_message
from retrieval.serve.settings import MAX_BODY_BYTES, MAX_PICTURES, MAX_SMALL_BODY_BYTES

PICTURE_PATHS = re.compile(r"/v1/(query|verify|objects/.+/touches)", re.DOTALL)
"""Routes whose bodies contain pictures: up to `MAX_BODY_BYTES`. All others: up to `MAX_SMALL_BODY_BYTES`."""
MAX_HELD_BYTES = 60_000_000
"""Maximum total size of the bodies in memory."""
MAX_JSON_VALUES = 2_000
"""Maximum number of JSON values of a body. A body with `MAX_PICTURES` pictures as data URLs, each in its own lists, and
with all options is counted with fewer than 1,200."""
MAX_GRASPS = 32
Body = TypeVar("Body", bound=BaseModel)
_CLOSE = {"connection": "close"}  # the rest of the body is not read


class BodyLimit:
    """Middleware that limits request bodies: size for the path, `seconds` to arrive, and the total of all bodies."""

    def __init__(self, app: ASGIApp, seconds: float) -> None:
        self.app, self.seconds, self.held_bytes = app, seconds, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on; refuse its body if it is too large or too slow (ASGI)."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        max_bytes = MAX_BODY_BYTES if PICTURE_PATHS.fullmatch(scope["path"]) else MAX_SMALL_BODY_BYTES
        announced = Headers(scope=scope).get("content-length", "0")
        if announced.isdecimal() and int(announced[:20]) > max_bytes:
            await too_large(max_bytes).response()(scope, receive, send)
            return
        deadline, received, whole = asyncio.get_running_loop().time() + self.seconds, 0, False

        async def limited() -> Message:
            nonlocal received, whole
            if whole:  # the next message is the disconnect
                return await receive()
            try:
                async with asyncio.timeout_at(deadline):
                    message = await receive()
            except TimeoutError:
                raise HttpProblem("too-slow", f"The body must arrive within {self.seconds:g} s.", _CLOSE) from None
            size = len(message.get("body", b""))
            received += size
            self.held_bytes += size
            if received > max_bytes:
                raise too_large(max_bytes)
            if self.held_bytes > MAX_HELD_BYTES:
                raise HttpProblem(
                    "busy", "Too many large requests are arriving. Try again.", _CLOSE | {"retry-after": "1"}
                )
            whole = not message.get("more_body", False)
            return message

        try:
            await self.app(scope, limited, send)
        finally:
            self.held_bytes -= received


def too_large(max_bytes: int) -> HttpProblem:
    """Return the problem for a body of more than `max_bytes` bytes."""
    advice = " Send smaller pictures." if max_bytes == MAX_BODY_BYTES else ""
    return HttpProblem("too-large", f"A request to this path may have at most {max_bytes:,} bytes.{advice}", _CLOSE)


_DATA_URL = re.compile(rb"\s*data:[^,]*;base64,", re.IGNORECASE)
_ALPHABET = bytes.maketrans(b"-_", b"+/")


def _decoded(text: Any) -> bytes:
    """Decode base64 in any number of lines, in the usual alphabet or that of URLs; padding and `data:` may lack."""
    try:
        data = text.encode("ascii")
        if url := _DATA_URL.match(data):
            data = data[url.end() :].replace(b"%2B", b"+").replace(b"%2F", b"/").replace(b"%3D", b"=")
        data = data.translate(_ALPHABET, b" \t\r\n").rstrip(b"=")
        return base64.b64decode(data + b"=" * (-len(data) % 4), validate=True)
    except (AttributeError, ValueError) as error:
        raise ValueError(f"must be an image file in base64: {error}") from error


Base64Image = Annotated[
    bytes,
    PlainValidator(_decoded),
    WithJsonSchema(
        {"type": "string", "contentEncoding": "base64", "description": "An image file in base64, or its data URL."}
    ),
]
Grasps = Annotated[list[Annotated[list[Base64Image], Field(min_length=1)]], Field(min_length=1, max_length=MAX_GRASPS)]
Openings = Annotated[
    list[Annotated[float, Field(gt=0)] | None] | None,
    Field(max_length=MAX_GRASPS, description="Opening of the jaws in mm for each grasp, null if not measured."),
]


class RequestBody(BaseModel):
    """A JSON body; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid")


class QueryBody(RequestBody):
    """The touches of one object, and the options of `retrieve query`."""

    touches: Grasps = Field(description="Grasps, each with one image for each finger.")
    background: list[Base64Image] | None = Field(None, description="No-contact frames, one for each finger.")
    opening_mm: Openings = None
    top: int = Field(10, ge=1, le=1000, description="Number of objects to return.")
    candidates: int | None = Field(
        None, ge=1, le=10_000_000, description="Photos that the fusion head scores; null for the index's own number."
    )
    none_prior: float = Field(
        NONE_PRIOR, gt=0, lt=1, description="Prior probability that the catalogue lacks the object."
    )


def json_body(model: type[BaseModel]) -> dict[str, Any]:
    """Return the OpenAPI description of a JSON body that the route parses itself, with `read_json`."""
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": model.model_json_schema()}}}}


@dataclass(eq=False)
class RequestPictures:
    """The image files of a request: of each finger of each grasp, and the no-contact frame of each finger, if any.

    images, frames: the decoded files, after `Queue.submit`. Raises HttpProblem for more than `MAX_PICTURES`.
    """

    files: Sequence[Sequence[bytes]]
    background: Sequence[bytes] | None
    images: list[list[GelImage]] = field(default_factory=list)
    frames: list[GelImage] | None = None

    def __post_init__(self) -> None:
        """Count the pictures."""
        if (count := len(self.named_files())) > MAX_PICTURES:
            raise HttpProblem("bad-input", f"A request may have at most {MAX_PICTURES} pictures, got {count}.")

    def named_files(self) -> list[tuple[str, bytes]]:
        """Return each file with its name for messages and answers."""
        return [
            *(
                (f"grasp {number}, finger {_letter(place)}", data)
                for number, grasp in enumerate(self.files, start=1)
                for place, data in enumerate(grasp)
            ),
            *((f"background of finger {_letter(place)}", data) for place, data in enumerate(self.background or ())),
        ]

    def set_images(self, images: Iterator[GelImage]) -> None:
        """Set the decoded images, in the order of `named_files`."""
        self.images = [[next(images) for _ in grasp] for grasp in self.files]
        self.frames = None if self.background is None else list(images)


async def read_json(request: Request, model: type[Body]) -> Body:
    """Return the JSON body of a request with pictures, parsed in a thread.

    Raises:
        HttpProblem: The body is not valid JSON for the model, or exceeds a limit.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise HttpProblem(
            "unsupported-type", f"The body must be application/json, got {kind[:100] or 'no content-type'}."
        )
    return await run_in_threadpool(_parsed, await request.body(), model)


def _parsed(data: bytes, model: type[Body]) -> Body:
    """Parse a body after a check that it cannot have more than `MAX_JSON_VALUES` values.

    Every JSON value except the first comes after one of `,:[{`. These characters do not occur in base64. Line breaks
    are removed: between values they mean nothing, and inside a string, where JSON forbids them, a script left them.
    """
    values = 1 + sum(map(data.count, (b",", b":", b"[", b"{")))
    if values > MAX_JSON_VALUES:
        raise HttpProblem(
            "bad-input", f"A body may have at most {MAX_JSON_VALUES:,} JSON values, got up to {values:,}."
        )
    try:
        return model.model_validate_json(data.translate(None, b"\r\n"))
    except ValidationError as error:
        errors = error.errors(include_input=False, include_url=False, include_context=False)
        is_malformed = any(detail["type"] == "json_invalid" for detail in errors)
        raise HttpProblem("malformed" if is_malformed else "bad-input", validation_message(errors)) from None


def _letter(place: int) -> str:
    return ascii_lowercase[place] if place < len(ascii_lowercase) else str(place + 1)
