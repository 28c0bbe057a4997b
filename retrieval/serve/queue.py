"""Queue of the requests that need the model, or a device.

The number of requests in flight is limited; further requests are answered with 429 immediately. A request is dropped
before its work begins if its client disconnects or the deadline passes.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from starlette.requests import Request

from retrieval.search.searcher import Searcher
from retrieval.serve.decoders import Decoders
from retrieval.serve.errors import HttpProblem
from retrieval.serve.generations import Generations
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.uploads import RequestPictures

Result = TypeVar("Result")


class Queue:
    """A thread that processes requests in the order of their arrival.

    Attributes:
        in_flight: Number of requests that wait or are being processed.
    """

    def __init__(self, generations: Generations, settings: ServiceSettings, decoders: Decoders) -> None:
        self._generations, self._settings, self._decoders = generations, settings, decoders
        self._threads = ThreadPoolExecutor(1)
        self.in_flight = 0

    def close(self) -> None:
        """Drop the waiting requests."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    def require_capacity(self) -> None:
        """Raise HttpProblem if the queue is full; called before the body of a request is read."""
        if self.in_flight >= self._settings.queue:
            raise HttpProblem(
                "busy",
                f"{self.in_flight} requests are in flight already. Try again.",
                {"retry-after": "1", "connection": "close"},
            )

    async def submit(
        self, work: Callable[[Searcher], Result], request: Request, pictures: RequestPictures | None = None
    ) -> Result:
        """Decode `pictures`, then run `work` in the thread with the generation that is served when it starts.

        The body of the request must have been read.

        Raises:
            HttpProblem: The queue is full, the client disconnects or the deadline passes.
            ImageError: A picture cannot be decoded.
            Exception: The errors of `work`.
        """

        async def until_disconnected() -> None:
            while (await request.receive())["type"] != "http.disconnect":
                pass

        self.require_capacity()
        self.in_flight += 1
        answer = asyncio.ensure_future(self._answer(work, pictures))
        answer.add_done_callback(self._release)
        disconnected: asyncio.Future[None] = asyncio.ensure_future(until_disconnected())
        either: set[asyncio.Future[Any]] = {answer, disconnected}
        seconds = self._settings.deadline_s
        try:
            await asyncio.wait(either, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
            if not answer.done():
                raise HttpProblem("late", f"No answer within {1e3 * seconds:g} ms.")
            return answer.result()
        finally:
            disconnected.cancel()
            answer.cancel()

    async def _answer(self, work: Callable[[Searcher], Result], pictures: RequestPictures | None) -> Result:
        """Decode the pictures, then wait for the model; cancelling stops both."""
        if pictures is not None:
            px = self._generations.current.checkpoint.config.preprocessing.touch_px
            images = await self._decoders.read(pictures.named_files(), px)
            pictures.set_images(iter(images))
        return await asyncio.wrap_future(self._threads.submit(lambda: work(self._generations.current)))

    def _release(self, answer: asyncio.Future[Any]) -> None:
        self.in_flight -= 1
        if not answer.cancelled():
            answer.exception()  # mark as retrieved: the client may have disconnected
