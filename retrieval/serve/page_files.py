"""Routes of the page's files, which are read once; a request never reaches the file system."""

import hashlib
import mimetypes
from pathlib import Path

from fastapi import APIRouter, Request, Response

from retrieval.serve.errors import HttpProblem

FOLDER = Path(__file__).parent / "page"
_TYPES = {".js": "text/javascript", ".svg": "image/svg+xml", ".woff2": "font/woff2", ".webmanifest": "application/json"}


def router_of(folder: Path = FOLDER) -> APIRouter:
    """Return routes for all files of a folder; `/` is its index.html."""
    router = APIRouter(include_in_schema=False)
    files = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()}
    answers = {f"/{name}": _answer(path) for name, path in files.items()}
    answers["/"] = answers["/index.html"]

    @router.api_route("/{name:path}", methods=["GET", "HEAD"])
    async def file(request: Request, name: str) -> Response:
        found = answers.get(f"/{name}")
        if found is None:
            raise HttpProblem("unknown", f"There is no page /{name[:200]}. /openapi.json lists the paths.")
        data, headers = found
        if request.headers.get("if-none-match") == headers["etag"]:
            return Response(status_code=304, headers=headers)
        return Response(data, headers=headers)

    return router


def _answer(path: Path) -> tuple[bytes, dict[str, str]]:
    """Return the bytes of a file and its response headers; browsers revalidate with the etag."""
    data = path.read_bytes()
    kind = _TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    charset = "; charset=utf-8" if kind.startswith("text/") else ""
    tag = hashlib.sha256(data).hexdigest()[:32]
    return data, {"content-type": kind + charset, "etag": f'"{tag}"', "cache-control": "no-cache"}
