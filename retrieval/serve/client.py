"""The same `query` as an opened index has, of an index on another machine."""

import base64
import io
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self, TypedDict, Unpack
from urllib.parse import quote

import numpy as np
from PIL import Image

from retrieval.data.images import read_bytes
from retrieval.errors import BadInput, ImageError, RetrievalError
from retrieval.model.gel_images import GelImage
from retrieval.model.touches import AnyImage, AnyTouches, InputImage, parse_grasps
from retrieval.search.query.answer import Match, QueryResult

try:
    import httpx
except ImportError as missing:
    raise BadInput("a client needs httpx; run: pip install 'touch-retrieval[serve]'") from missing

_PNG_MODES = frozenset({"1", "L", "LA", "P", "RGB", "RGBA"})
_BAD_INPUT_KINDS = frozenset(
    {"malformed", "bad-input", "too-large", "unsupported-type", "unknown", "conflict", "no-token"}
)


class QueryOptions(TypedDict, total=False):
    """The keywords of `Searcher.query`, which says what they mean and what holds where one is left out."""

    background: Sequence[AnyImage] | None
    top: int
    candidates: int | None
    none_prior: float


class Client:
    """A service of `retrieve serve`, asked as a `Searcher` is: a robot's code does not change when the index moves.

    url: where it listens. token: what it asks for, where it listens to other machines. timeout_s: for one answer,
    waiting for a place in the queue included. Any number of threads may use it. `close` it, or use it by `with`.

    >>> with retrieval.Client("http://127.0.0.1:1") as client:
    ...     client.query(["a.png", "b.png"])
    Traceback (most recent call last):
    retrieval.errors.RetrievalError: http://127.0.0.1:1 cannot be reached (...); is `retrieve serve` running there?
    """

    def __init__(
        self, url: str = "http://127.0.0.1:8000", *, token: str | None = None, timeout_s: float = 60.0
    ) -> None:
        headers = {} if token is None else {"authorization": f"Bearer {token}"}
        self.url, self._timeout_s = url, timeout_s
        self._http = httpx.Client(base_url=url, headers=headers, timeout=timeout_s)
        self._fingers: int | None = None

    def close(self) -> None:
        """Let go of the connection."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def query(self, touches: AnyTouches, **options: Unpack[QueryOptions]) -> QueryResult:
        """`Searcher.query` with its keywords, answered there. Paths are of this machine, `Match.photo_path` is of the
        other: `photo` gets the picture. Raises what that raises, and RetrievalError where no answer can be had.
        """
        return self._ask("query", touches, options)[0]

    def query_cumulative(self, touches: AnyTouches, **options: Unpack[QueryOptions]) -> list[QueryResult]:
        """`Searcher.query_cumulative`, answered there; see `query`."""
        return self._ask("query/cumulative", touches, options)

    def query_many(self, objects: Sequence[AnyTouches], **options: Unpack[QueryOptions]) -> list[QueryResult]:
        """`Searcher.query_many`, answered there; see `query`."""
        if not objects:
            return []
        queries = [self._grasps(one, f"object {number}, ") for number, one in enumerate(objects, start=1)]
        body = {"objects": [_encoded(grasps) for grasps in queries], **_request_options(options)}
        answers = _document(self._send("POST", "query/batch", json=body), "answers")["answers"]
        return [_result(answer, grasps) for answer, grasps in zip(answers, queries, strict=True)]

    def photo(self, match: Match) -> bytes:
        """The file of a match's photo. Raises BadInput where it is gone."""
        return self._send("GET", f"photos/{quote(match.photo)}").content

    def _ask(self, path: str, touches: AnyTouches, options: QueryOptions) -> list[QueryResult]:
        grasps = self._grasps(touches)
        answer = _document(self._send("POST", path, json={"touches": _encoded(grasps), **_request_options(options)}))
        return [_result(one, grasps) for one in answer.get("answers", [answer])]

    def _grasps(self, touches: AnyTouches, of: str = "") -> list[list[InputImage]]:
        if self._fingers is None:
            self._fingers = int(_document(self._send("GET", "index"), "fingers")["fingers"])
        return parse_grasps(touches, self._fingers, of=of)

    def _send(self, method: str, path: str, **request: Any) -> httpx.Response:
        """The response; where the service is busy, it is asked again when it says so, until the time is over."""
        until = time.monotonic() + self._timeout_s
        while True:
            try:
                response = self._http.request(method, f"/v1/{path}", **request)
            except (httpx.HTTPError, httpx.InvalidURL) as error:
                raise RetrievalError(
                    f"{self.url} cannot be reached ({error}); is `retrieve serve` running there?"
                ) from error
            retry_after = response.headers.get("retry-after", "")
            pause = float(retry_after) if retry_after.isdecimal() else 1.0  # a proxy may name a date
            if response.status_code not in (429, 503) or time.monotonic() + pause > until:
                break
            time.sleep(pause)
        if response.is_error:
            raise _error(response)
        return response


def _document(response: httpx.Response, *keys: str) -> dict[str, Any]:
    """The JSON object of a response, which has these keys. Raises RetrievalError for another one: what listens there
    is no service of ours.
    """
    try:
        found = response.json()
    except ValueError as error:
        raise _unexpected_response(response) from error
    if not isinstance(found, dict) or not all(key in found for key in keys):
        raise _unexpected_response(response)
    return found


def _unexpected_response(response: httpx.Response) -> RetrievalError:
    return RetrievalError(f"{response.url} answered {response.status_code}, and not as `retrieve serve` does")


def _error(response: httpx.Response) -> RetrievalError:
    """What a problem document means in Python."""
    try:
        problem = response.json()
        kind, detail = problem["type"].rpartition(":")[2], problem["detail"]
    except (ValueError, KeyError, TypeError, AttributeError):
        return _unexpected_response(response)
    if kind == "bad-image":
        name, _, reason = detail.partition(": ")
        return ImageError(name, reason)
    return BadInput(detail) if kind in _BAD_INPUT_KINDS else RetrievalError(detail)


def _result(answer: dict[str, Any], grasps: list[list[InputImage]]) -> QueryResult:
    """The answer, whose images are called as they were given here."""
    result = QueryResult.from_dict(answer)
    names = [[image.name for image in grasp] for grasp in grasps]
    return replace(result, touches=names[: len(result.touches)])


def _request_options(options: QueryOptions) -> dict[str, Any]:
    """The options of a query as the service takes them in a body, beside the touches."""
    frames = options.get("background")
    if frames is None:
        return dict(options)
    images = [InputImage(image, f"background {number}") for number, image in enumerate(frames, start=1)]
    return {**options, "background": [_base64(image) for image in images]}


def _encoded(grasps: list[list[InputImage]]) -> list[list[str]]:
    return [[_base64(image) for image in grasp] for grasp in grasps]


def _base64(given: InputImage) -> str:
    return base64.b64encode(_file(given)).decode("ascii")


def _file(given: InputImage) -> bytes:
    """An image as a file that reads as the same numbers there. Raises ImageError."""
    image = given.image
    if isinstance(image, bytes | bytearray | memoryview):
        return bytes(image)
    if isinstance(image, Image.Image) and image.mode in _PNG_MODES:
        return _png(image, given.name)
    if isinstance(image, Image.Image | np.ndarray):
        return _png(Image.fromarray(np.rint(255 * given.read()).astype(np.uint8)), given.name)
    assert not isinstance(image, GelImage), "only the service reads gel images ahead"
    return read_bytes(os.fspath(image))


def _png(image: Image.Image, name: str) -> bytes:
    file = io.BytesIO()
    try:
        image.save(file, "PNG", compress_level=1, exif=image.getexif())
    except OSError as error:  # the file behind it is damaged
        raise ImageError(name, f"damaged or truncated: {error}") from error
    return file.getvalue()
