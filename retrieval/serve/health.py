"""Whether the service lives, whether it is ready, and its numbers; and the page's cookie."""

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, Field

from retrieval.serve.errors import HttpProblem, problem_responses
from retrieval.serve.security import COOKIE, same_token
from retrieval.serve.service import Parts
from retrieval.serve.uploads import RequestBody, json_body, read_json

router = APIRouter(tags=["health"])


class Health(BaseModel):
    """status: "ok", or why not."""

    status: str


@router.get("/healthz")
async def healthz() -> Health:
    """The process answers."""
    return Health(status="ok")


@router.get("/readyz", responses=problem_responses("not-ready"))
async def ready(parts: Parts) -> Health:
    """An index is open, and the service is not about to end."""
    if parts.stopping.is_set():
        raise HttpProblem("not-ready", "the service is about to end")
    return Health(status=f"ok: {parts.generations.current.name}")


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
async def metrics(parts: Parts) -> Response:
    """Numbers for Prometheus."""
    return Response(parts.metrics.render(), media_type="text/plain; version=0.0.4; charset=utf-8")


class SessionBody(RequestBody):
    """The service's token."""

    token: str = Field(max_length=1000)


@router.post(
    "/v1/session",
    status_code=204,
    responses=problem_responses("bad-input", "too-large", "too-slow", "unsupported-type"),
    openapi_extra=json_body("SessionBody"),
)
async def session(request: Request, parts: Parts) -> Response:
    """For the page of a service with a token: the token becomes a cookie that scripts cannot read, for pictures cannot
    send a header.
    """
    body = await read_json(request, SessionBody)
    wanted = parts.settings.token
    if wanted is not None and not same_token(body.token, wanted):
        raise HttpProblem("no-token", "this is not the service's token", {"www-authenticate": "Bearer"})
    response = Response(status_code=204)
    if wanted is not None:
        response.set_cookie(COOKIE, wanted, httponly=True, samesite="strict", path="/")
    return response


@router.delete("/v1/session", status_code=204)
async def end_session() -> Response:
    """Take the cookie away."""
    response = Response(status_code=204)
    response.delete_cookie(COOKIE, httponly=True, samesite="strict", path="/")
    return response
