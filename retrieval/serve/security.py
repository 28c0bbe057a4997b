"""Access control, the security headers of every response, and the routes that need no token.

Without a token, only requests from this machine are answered. Requests that a foreign page in a local browser sends
name the foreign host or origin, and are refused.
"""

import asyncio
import hmac
import logging
from contextlib import suppress
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

from fastapi import APIRouter, Response
from pydantic import Field
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from retrieval.serve.errors import HttpProblem, problem_of
from retrieval.serve.service import Parts
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.uploads import RequestBody

log = logging.getLogger(__name__)
COOKIE = "retrieve-token"
_LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
_OPEN_PATHS = frozenset({"/healthz", "/readyz", "/v1/session", "/openapi.json"})
"""Paths that need no token, in addition to the files of the page, which contain no user data."""
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "media-src 'self' blob:; connect-src 'self'; font-src 'self'; manifest-src 'self'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(self), microphone=(), geolocation=()",
}


def same_token(candidate: str, token: str) -> bool:
    """Compare two tokens in constant time."""
    return hmac.compare_digest(candidate.encode("utf-8", "replace"), token.encode())


class Guard:
    """Middleware that refuses unauthorised requests unread, and adds HEADERS to every response."""

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self.app, self.settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it (ASGI)."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        if scope["method"] == "HEAD":  # of the answer to GET, the server sends only the headers
            scope = {**scope, "method": "GET"}
        begun = False

        async def with_headers(message: Message) -> None:
            nonlocal begun
            if message["type"] == "http.response.start":
                begun = True
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                is_page = not scope["path"].startswith("/v1/")  # browsers check its files for changes
                headers.setdefault("cache-control", "no-cache" if is_page else "no-store")
            await send(message)

        if problem := self._refusal(scope["path"], Headers(scope=scope)):
            await problem.response()(scope, receive, with_headers)
            return
        try:
            await self.app(scope, receive, with_headers)
        except asyncio.CancelledError:  # the server shuts down, and the grace period is over
            if not begun:
                detail, headers = "The service is shutting down.", {"retry-after": "1", "connection": "close"}
                await HttpProblem("not-ready", detail, headers).response()(scope, receive, with_headers)
        except Exception as error:
            log.exception("Unexpected error at %s", scope["path"])
            if begun:  # the connection is cut, so that the client does not take a partial answer for a whole one
                raise
            await problem_of(error).response()(scope, receive, with_headers)

    def _refusal(self, path: str, headers: Headers) -> HttpProblem | None:
        try:
            host = urlsplit(f"//{headers.get('host', '')}").hostname
        except ValueError:
            host = None
        if self.settings.is_local and host not in _LOCAL_NAMES:
            return HttpProblem(
                "wrong-host", "This service answers only this machine: use the host localhost or 127.0.0.1."
            )
        origin, site = headers.get("origin"), headers.get("sec-fetch-site")  # browsers set them, pages cannot
        if origin is not None and site != "same-origin" and urlsplit(origin).netloc != headers.get("host"):
            return HttpProblem("refused", "Pages of another origin may not use this service.")
        if site in ("cross-site", "same-site") and headers.get("sec-fetch-mode") != "navigate":
            return HttpProblem("refused", "Pages of another site may not use this service.")
        token = self.settings.token
        if token is None or path in _OPEN_PATHS or not path.startswith("/v1/"):
            return None
        if any(same_token(candidate, token) for candidate in _request_tokens(headers)):
            return None
        detail = "Send the service's token as `Authorization: Bearer TOKEN`."
        return HttpProblem("no-token", detail, {"www-authenticate": "Bearer"})


def _request_tokens(headers: Headers) -> list[str]:
    """Return the tokens of a request: from the header (programs) and from the cookie (the page)."""
    scheme, _, value = headers.get("authorization", "").partition(" ")
    tokens = [value.strip()] if scheme.lower() == "bearer" else []
    with suppress(CookieError):
        tokens += [morsel.value for name, morsel in SimpleCookie(headers.get("cookie", "")).items() if name == COOKIE]
    return tokens


# Routes ---------------------------------------------------------------------------------------------------------------

router = APIRouter(tags=["health"])


@router.get("/healthz")
async def healthz() -> dict[str, str]:
    """Return "ok" while the process runs."""
    return {"status": "ok"}


@router.get("/readyz")
async def ready(parts: Parts) -> dict[str, str]:
    """Return "ok" and the generation if an index is open and the service is not shutting down."""
    if parts.stopping.is_set():
        raise HttpProblem("not-ready", "The service is shutting down.")
    return {"status": f"ok: {parts.generations.current.manifest.generation}"}


class SessionBody(RequestBody):
    """The service's token."""

    token: str = Field(max_length=1000)


@router.post("/v1/session", status_code=204)
async def session(body: SessionBody, parts: Parts) -> Response:
    """Store the token in a cookie that scripts cannot read.

    The page needs it, because requests for images cannot send a header. Browsers send it back only below the path of
    this route, so other services of the host do not receive it.
    """
    token = parts.settings.token
    if token is not None and not same_token(body.token, token):
        raise HttpProblem("no-token", "This is not the service's token.", {"www-authenticate": "Bearer"})
    response = Response(status_code=204)
    if token is not None:
        response.set_cookie(COOKIE, token, httponly=True, samesite="strict", path=None)
    return response
