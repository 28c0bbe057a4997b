"""Problem documents (RFC 9457) for all errors: a type for programs, and a sentence for people."""

from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from indexes.errors import IndexesError
from retrieval.data.text import replace_surrogates
from retrieval.errors import BadInput, ImageError, IncompleteSearch, RetrievalError

MEDIA_TYPE = "application/problem+json"
PREFIX = "urn:touch-retrieval:problem:"

KINDS: Mapping[str, tuple[int, str]] = {
    "malformed": (400, "The request is malformed"),
    "no-token": (401, "A token is required"),
    "refused": (403, "The request is refused"),
    "unknown": (404, "Not found"),
    "not-allowed": (405, "This path does not support the method"),
    "too-slow": (408, "The request took too long to arrive"),
    "conflict": (409, "A different value is stored already"),
    "too-large": (413, "The request is too large"),
    "unsupported-type": (415, "The content type of the body is not supported"),
    "wrong-host": (421, "The request is meant for another host"),
    "bad-input": (422, "The input cannot be used"),
    "bad-image": (422, "An image cannot be read"),
    "busy": (429, "The service is at capacity"),
    "failed": (500, "The service failed"),
    "not-ready": (503, "The service is not ready"),
    "late": (504, "The deadline passed"),
}
"""Kind of a problem -> HTTP status and title."""
_OF_STATUS = {400: "malformed", 404: "unknown", 405: "not-allowed", 413: "too-large", 415: "unsupported-type"}


class DocumentResponse(JSONResponse):
    """JSON response that replaces text that UTF-8 cannot encode, such as some file names, by U+FFFD."""

    def render(self, content: Any) -> bytes:
        """Return the document as bytes (Starlette callback)."""
        return super().render(replace_surrogates(content))


class HttpProblem(HTTPException):
    """An error that becomes a problem document: a key of `KINDS`, a sentence for people, and further headers."""

    def __init__(self, kind: str, detail: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(KINDS[kind][0], detail, headers)
        self.kind = kind

    def response(self) -> JSONResponse:
        """Return the problem document as a response."""
        status, title = KINDS[self.kind]
        document = {"type": PREFIX + self.kind, "title": title, "status": status, "detail": self.detail}
        return DocumentResponse(document, status, {"cache-control": "no-store", **(self.headers or {})}, MEDIA_TYPE)


_TEXT = {"type": "string"}
_PROBLEM = {"type": _TEXT, "title": _TEXT, "status": {"type": "integer"}, "detail": _TEXT}
PROBLEM_RESPONSES: dict[int | str, dict[str, Any]] = {
    "default": {
        "description": "A problem document (RFC 9457).",
        "content": {MEDIA_TYPE: {"schema": {"type": "object", "properties": _PROBLEM, "required": [*_PROBLEM]}}},
    }
}
"""OpenAPI description of all errors of a route."""


def problem_of(error: Exception) -> HttpProblem:
    """Return the problem document for an exception."""
    match error:
        case HttpProblem():
            return error
        case ImageError():
            return HttpProblem("bad-image", str(error))
        case BadInput():
            return HttpProblem("bad-input", str(error))
        case IncompleteSearch():
            return HttpProblem("not-ready", str(error), {"retry-after": "1"})
        case RetrievalError() | IndexesError():
            return HttpProblem("failed", str(error))
        case RequestValidationError():
            return HttpProblem("bad-input", validation_message(error.errors()))
        case ClientDisconnect():
            return HttpProblem("malformed", "The connection ended before the whole body arrived.")
        case HTTPException():
            kind = _OF_STATUS.get(error.status_code, "malformed" if error.status_code < 500 else "failed")
            return HttpProblem(kind, str(error.detail), error.headers)
        case _:
            return HttpProblem("failed", f"Unexpected {type(error).__name__}. See the log of the service.")


def validation_message(errors: Any) -> str:
    """Return the first five validation errors of pydantic, each with its place, as one sentence."""
    messages = [f"{'.'.join(map(str, error['loc']))}: {error['msg']}" for error in list(errors)[:5]]
    return "; ".join(messages) or "The request does not match the schema in /openapi.json."


def install_handlers(app: FastAPI) -> None:
    """Convert the errors of this project to problem documents; `security.Guard` converts all others."""

    async def answer(request: Request, error: Exception) -> JSONResponse:
        return problem_of(error).response()

    for kind in (HttpProblem, RetrievalError, IndexesError, RequestValidationError, ClientDisconnect, HTTPException):
        app.add_exception_handler(kind, answer)
