"""Queue of the requests that need the model.

The number of requests in flight is limited; further requests are answered with 429 immediately. A request is dropped
before its work begins if its client disconnects or its deadline passes. Waiting queries with equal options are answered
as one batch: the encoder is no faster in a batch, but the interpreter's work is done once.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from threading import Condition, Thread
from typing import Any, TypeVar

from starlette.requests import Request

from retrieval.serve.decoders import Decoders
from retrieval.serve.errors import HttpProblem
from retrieval.serve.generations import Generations, ServedGeneration
from retrieval.serve.metrics import Metrics
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.uploads import ParsedQuery, RequestPictures

Result = TypeVar("Result")


@dataclass(eq=False)
class _Job:
    """Work for the model, with decoded pictures.

    Attributes:
        work: The function to run with the served generation.
        parsed_query: The query if the work is a plain query, which can be batched; else None.
        answer: Receives the result.
        began: Arrival of the request (`time.monotonic`).
        deadline: Time after which the work is dropped (`time.monotonic`).
    """

    work: Callable[[ServedGeneration], Any]
    parsed_query: ParsedQuery | None
    answer: asyncio.Future[Any]
    began: float
    deadline: float


class Queue:
    """Requests that wait for the model, in the order of their arrival.

    Worker threads take jobs from the queue directly, so that they do not wait for the event loop.

    Attributes:
        in_flight: Number of requests that wait or are being processed.
    """

    def __init__(
        self, generations: Generations, settings: ServiceSettings, metrics: Metrics, decoders: Decoders
    ) -> None:
        self._generations, self._settings, self._metrics = generations, settings, metrics
        self._decoders = decoders
        self._jobs: deque[_Job] = deque()
        self._changed, self._closed = Condition(), False
        self._threads: list[Thread] = []
        self.in_flight = 0

    def start(self) -> None:
        """Start the worker threads for the running event loop."""
        loop = asyncio.get_running_loop()
        self._threads = [Thread(target=self._work, args=(loop,), daemon=True) for _ in range(self._settings.workers)]
        for thread in self._threads:
            thread.start()

    def close(self, seconds: float) -> None:
        """Finish the waiting jobs and end; abandon work that takes longer than `seconds`."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        until = time.monotonic() + seconds
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))

    def require_capacity(self) -> None:
        """Raise HttpProblem if the queue is full; called before the body of a request is read."""
        if self.in_flight >= self._settings.queue:
            self._metrics.dropped.labels("busy").inc()
            raise HttpProblem(
                "busy",
                f"{self.in_flight} requests are in flight already. Try again.",
                {"retry-after": "1", "connection": "close"},
            )

    async def submit(
        self,
        work: Callable[[ServedGeneration], Result],
        request: Request,
        deadline_ms: float | None = None,
        pictures: RequestPictures | None = None,
        parsed_query: ParsedQuery | None = None,
    ) -> Result:
        """Decode `pictures`, then run `work` with the generation that is served when it starts.

        Args:
            work: Function of the generation; it runs in a worker thread.
            request: The request, to notice that the client disconnects.
            deadline_ms: Deadline of the client in milliseconds; the service's own deadline also applies.
            pictures: Pictures to decode first.
            parsed_query: The query, if the work is a plain query that can be batched.

        Returns:
            The result of `work`.

        Raises:
            HttpProblem: The queue is full, the client disconnects or the deadline passes.
            ImageError: A picture cannot be decoded.
            Exception: The errors of `work`.
        """
        self.require_capacity()
        now = time.monotonic()
        seconds = min(self._settings.deadline_s, (deadline_ms or 1e9) / 1e3)
        self.in_flight += 1
        self._metrics.in_flight.inc()
        answer = asyncio.ensure_future(self._answer(work, pictures, parsed_query, now, now + seconds))
        answer.add_done_callback(self._release)
        disconnected: asyncio.Future[None] = asyncio.ensure_future(_wait_for_disconnect(request))
        either: set[asyncio.Future[Any]] = {answer, disconnected}
        try:
            await asyncio.wait(either, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
            if not answer.done():
                client_left = disconnected.done()
                self._metrics.dropped.labels("disconnected" if client_left else "late").inc()
                raise HttpProblem(
                    "late", "The client disconnected." if client_left else f"No answer within {1e3 * seconds:g} ms."
                )
            return answer.result()
        finally:
            disconnected.cancel()
            answer.cancel()

    async def _answer(
        self,
        work: Callable[[ServedGeneration], Result],
        pictures: RequestPictures | None,
        parsed_query: ParsedQuery | None,
        began: float,
        deadline: float,
    ) -> Result:
        """Decode the pictures, then wait for the model; cancelling stops both."""
        if pictures is not None:
            px = self._generations.current.searcher.checkpoint.config.preprocessing.touch_px
            images = await self._decoders.read(pictures.named_files(), px, pictures.background is not None)
            pictures.set_images(iter(images))
            self._metrics.stages.labels("pictures").observe(time.monotonic() - began)
        answer: asyncio.Future[Result] = asyncio.get_running_loop().create_future()
        job = _Job(work, parsed_query, answer, began, deadline)
        with self._changed:
            self._jobs.append(job)
            self._changed.notify_all()
        try:
            return await answer
        finally:
            with self._changed:
                if job in self._jobs:
                    self._jobs.remove(job)

    def _release(self, answer: asyncio.Future[Any]) -> None:
        self.in_flight -= 1
        self._metrics.in_flight.dec()
        if not answer.cancelled():
            answer.exception()  # mark as retrieved: the client may have disconnected

    def _work(self, loop: asyncio.AbstractEventLoop) -> None:
        while jobs := self._next_batch():
            generation, now = self._generations.current, time.monotonic()
            for job in jobs:
                self._metrics.waiting.observe(now - job.began)
            self._metrics.batches.observe(len(jobs))
            answers = _answers(generation, jobs)
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(_set_results, jobs, answers)

    def _next_batch(self) -> list[_Job]:
        """Return the next job and the waiting jobs that can be batched with it; empty at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._jobs or self._closed)
            if not self._jobs:
                return []
            jobs = [self._jobs.popleft()]
            first = jobs[0].parsed_query
            while first and self._jobs and len(jobs) < self._settings.max_batch:
                following = self._jobs[0].parsed_query
                if not following or not following.can_batch_with(first):
                    break
                jobs.append(self._jobs.popleft())
            return jobs


async def _wait_for_disconnect(request: Request) -> None:
    """Return when the client disconnects; the body must have been read."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _set_results(jobs: list[_Job], answers: list[Any]) -> None:
    for job, answer in zip(jobs, answers, strict=True):
        if job.answer.done():
            continue
        if isinstance(answer, Exception):
            job.answer.set_exception(answer)
        else:
            job.answer.set_result(answer)


def _answers(generation: ServedGeneration, jobs: list[_Job]) -> list[Any]:
    """Return the result or the exception of each job; a failing query does not affect the others."""
    parsed_queries = [job.parsed_query for job in jobs if job.parsed_query is not None]
    if len(jobs) > 1:
        with suppress(BaseException):  # if the batch fails, each query is answered separately
            images = [one.pictures.images[0] for one in parsed_queries]
            return list(generation.searcher.query_many(images, **parsed_queries[0].keywords))
    return [_answer(generation, job) for job in jobs]


def _answer(generation: ServedGeneration, job: _Job) -> Any:
    if time.monotonic() > job.deadline:
        return HttpProblem("late", "The deadline passed before the request was processed.")
    try:
        return job.work(generation)
    except BaseException as error:
        if isinstance(error, Exception) and not isinstance(error, StopIteration):
            return error
        return RuntimeError(repr(error))  # a future takes no StopIteration, and SystemExit would end the event loop
