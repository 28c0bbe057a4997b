"""Client of the service: `Searcher.query` for an index on another machine."""

import base64
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, Self, TypedDict, Unpack
from urllib.parse import quote

from retrieval.data.opening import Openings, parse_openings
from retrieval.errors import BadInput, ImageError, RetrievalError
from retrieval.model.touches import AnyImage, AnyTouches, InputImage, image_file, parse_grasps
from retrieval.search.answer import Enrolment, Match, QueryResult

try:
    import httpx
except ImportError as missing:
    raise BadInput("A client needs httpx. Run: pip install 'touch-retrieval[serve]'") from missing


class QueryOptions(TypedDict, total=False):
    """The other keyword arguments of `Searcher.query`, with the same meanings and defaults."""

    background: Sequence[AnyImage] | None
    top: int
    candidates: int | None
    none_prior: float


class Client:
    """Client of `retrieve serve` with the query methods of `Searcher`.

    A robot's code does not change if the index moves to another machine. Any number of threads may share a client.
    Call `close`, or use it in a `with` statement.

    Args:
        url: Address of the service.
        token: Token of the service; required if it listens to other machines.
        timeout_s: Time limit for one answer in seconds, including the wait for a place in the queue.

    >>> with retrieval.Client("http://127.0.0.1:1") as client:
    ...     client.query(["a.png", "b.png"])
    Traceback (most recent call last):
    retrieval.errors.RetrievalError: Cannot reach http://127.0.0.1:1 (...). Is `retrieve serve` running there?
    """

    def __init__(
        self, url: str = "http://127.0.0.1:8000", *, token: str | None = None, timeout_s: float = 60.0
    ) -> None:
        headers = {} if token is None else {"authorization": f"Bearer {token}"}
        self.url, self._timeout_s = url, timeout_s
        self._http = httpx.Client(base_url=url, headers=headers, timeout=timeout_s)
        self._fingers: int | None = None

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def query(
        self, touches: AnyTouches, *, opening_mm: Openings = None, **options: Unpack[QueryOptions]
    ) -> QueryResult:
        """Run `Searcher.query` on the service; paths of touches refer to this machine.

        `Match.photo_path` of the result refers to the other machine; `photo` returns the picture.

        Raises:
            BadInput: The input cannot be used.
            ImageError: An image cannot be read.
            RetrievalError: No answer is available.
        """
        grasps = self._grasps(touches)
        body = {**options, **_pictures(grasps, options.get("background"), opening_mm)}
        result = QueryResult.from_dict(_document(self._send("POST", "query", json=body)))
        names = [[image.name for image in grasp] for grasp in grasps]  # those of this machine
        return replace(result, touches=names[: len(result.touches)])

    def query_many(
        self,
        objects: Sequence[AnyTouches],
        *,
        opening_mm: Sequence[Openings] | None = None,
        **options: Unpack[QueryOptions],
    ) -> list[QueryResult]:
        """Run `query` for each object, with its openings."""
        openings = [None] * len(objects) if opening_mm is None else opening_mm
        return [
            self.query(touches, opening_mm=opening, **options)
            for touches, opening in zip(objects, openings, strict=True)
        ]

    def enrol(
        self,
        object_id: str,
        touches: AnyTouches,
        *,
        opening_mm: Openings = None,
        background: Sequence[AnyImage] | None = None,
    ) -> Enrolment:
        """Run `Searcher.enrol` on the service; raise as `query`."""
        grasps = self._grasps(touches)
        name = quote(object_id, safe="").replace(".", "%2E")  # else "a/../b" would become "b"
        path = f"objects/{name}/touches"
        answer = _document(self._send("POST", path, json=_pictures(grasps, background, opening_mm)), "added")
        return Enrolment(answer["object_id"], answer["touches"], len(answer["added"]))

    def photo(self, match: Match) -> bytes:
        """Return the file of a match's photo.

        Raises:
            BadInput: The service has no such photo.
        """
        return self._send("GET", f"photos/{quote(match.photo)}").content

    def _grasps(self, touches: AnyTouches) -> list[list[InputImage]]:
        if self._fingers is None:
            self._fingers = int(_document(self._send("GET", "index"), "fingers")["fingers"])
        return parse_grasps(touches, self._fingers)

    def _send(self, method: str, path: str, **request: Any) -> httpx.Response:
        """Send a request; while the service is busy, retry after its `Retry-After` until the time limit."""
        until = time.monotonic() + self._timeout_s
        while True:
            try:
                response = self._http.request(method, f"/v1/{path}", **request)
            except (httpx.HTTPError, httpx.InvalidURL) as error:
                raise RetrievalError(
                    f"Cannot reach {self.url} ({error}). Is `retrieve serve` running there?"
                ) from error
            retry_after = response.headers.get("retry-after", "")
            pause = float(retry_after) if retry_after.isdecimal() else 1.0  # a proxy may send a date
            if response.status_code not in (429, 503) or time.monotonic() + pause > until:
                break
            time.sleep(pause)
        if response.is_error:
            raise _error(response)
        return response


def _document(response: httpx.Response, *keys: str) -> dict[str, Any]:
    """Return the JSON object of a response, or raise RetrievalError if one of `keys` is missing."""
    with suppress(ValueError):  # not JSON
        document = response.json()
        if isinstance(document, dict) and all(key in document for key in keys):
            return document
    raise RetrievalError(
        f"{response.url}: unexpected response ({response.status_code}); not a `retrieve serve` service."
    )


def _error(response: httpx.Response) -> RetrievalError:
    """Return the exception for a problem document."""
    problem = _document(response, "type", "detail")
    kind, detail = str(problem["type"]).rpartition(":")[2], str(problem["detail"])
    if kind == "bad-image":
        name, _, reason = detail.partition(": ")
        return ImageError(name, reason)
    return BadInput(detail) if response.is_client_error and kind != "busy" else RetrievalError(detail)


def _pictures(
    grasps: Sequence[Sequence[InputImage]], background: Sequence[AnyImage] | None, opening_mm: Openings
) -> dict[str, Any]:
    """Return the part of a body that describes the grasps."""
    frames = [InputImage(image, f"background {number}") for number, image in enumerate(background or (), start=1)]
    return {
        "touches": [_encoded(grasp) for grasp in grasps],
        "background": None if background is None else _encoded(frames),
        "opening_mm": parse_openings(opening_mm, len(grasps)),
    }


def _encoded(images: Sequence[InputImage]) -> list[str]:
    return [base64.b64encode(image_file(image)).decode("ascii") for image in images]
