"""Routes for liveness and readiness, and for the session cookie of the page."""

from fastapi import APIRouter, Response
from pydantic import BaseModel, Field

from retrieval.serve.errors import HttpProblem
from retrieval.serve.security import COOKIE, same_token
from retrieval.serve.service import Parts
from retrieval.serve.uploads import RequestBody

router = APIRouter(tags=["health"])


class Health(BaseModel):
    """State of the service. status: "ok" and, for readiness, the generation."""

    status: str


@router.get("/healthz")
async def healthz() -> Health:
    """Return "ok" while the process runs."""
    return Health(status="ok")


@router.get("/readyz")
async def ready(parts: Parts) -> Health:
    """Return "ok" and the generation if an index is open and the service is not shutting down."""
    if parts.stopping.is_set():
        raise HttpProblem("not-ready", "The service is shutting down.")
    return Health(status=f"ok: {parts.generations.current.name}")


class SessionBody(RequestBody):
    """The service's token."""

    token: str = Field(max_length=1000)


@router.post("/v1/session", status_code=204)
async def session(body: SessionBody, parts: Parts) -> Response:
    """Store the token in a cookie that scripts cannot read.

    The page needs it, because requests for images cannot send a header.
    """
    token = parts.settings.token
    if token is not None and not same_token(body.token, token):
        raise HttpProblem("no-token", "This is not the service's token.", {"www-authenticate": "Bearer"})
    response = Response(status_code=204)
    if token is not None:
        response.set_cookie(COOKIE, token, httponly=True, samesite="strict", path="/")
    return response


@router.delete("/v1/session", status_code=204)
async def end_session() -> Response:
    """Delete the cookie."""
    response = Response(status_code=204)
    response.delete_cookie(COOKIE, httponly=True, samesite="strict", path="/")
    return response
