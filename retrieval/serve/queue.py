"""Who waits for the model, and for how long.

So many requests are held at once, the one in work among them; the next is told at once to come again. A request whose
asker has left, or whose deadline has passed, is dropped before it is worked on. With a window, queries that come
together and ask alike are encoded together.
"""

import asyncio
import time
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

from starlette.requests import Request

from retrieval.errors import RetrievalError
from retrieval.search.answer import QueryResult
from retrieval.serve.errors import Problem
from retrieval.serve.generations import Generations, Opened
from retrieval.serve.metrics import Metrics
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.uploads import Asked

Result = TypeVar("Result")


class Answered(NamedTuple):
    """An answer, and the digest of the model that gave it."""

    result: QueryResult
    model: str


@dataclass(eq=False)
class _Job:
    """Work for the model. asked: the query, where it is one and nothing else."""

    work: Callable[[Opened], Any]
    asked: Asked | None
    answer: asyncio.Future[Any]
    began: float
    deadline: float


class Queue:
    """Requests that wait for the model, in the order in which they came."""

    def __init__(self, generations: Generations, settings: ServiceSettings, metrics: Metrics) -> None:
        self._generations, self._settings, self._metrics = generations, settings, metrics
        self._jobs: asyncio.Queue[_Job] = asyncio.Queue()
        self._threads = ThreadPoolExecutor(settings.workers, "query")
        self._held = 0
        self._next: _Job | None = None  # did not fit to those before it

    def workers(self) -> list[Coroutine[Any, Any, None]]:
        """What must run for anything to be answered."""
        return [self._work() for _ in range(self._settings.workers)]

    def close(self) -> None:
        """Let go of the threads."""
        self._threads.shutdown()

    @property
    def held(self) -> int:
        """Requests that wait or are in work."""
        return self._held

    def require_room(self) -> None:
        """Raises Problem where one more request would not be held; asked before its body is read."""
        if self._held >= self._settings.queue:
            self._metrics.dropped.labels("busy").inc()
            raise Problem(
                "busy",
                f"{self._held} requests are held already; come again",
                {"retry-after": "1", "connection": "close"},
            )

    async def ask(self, asked: Asked, request: Request) -> Answered:
        """Answer a query. Raises Problem, and the errors of `Searcher.query`."""
        answered: Answered = await self.do(
            lambda opened: Answered(opened.searcher.query(asked.touches, **asked.keywords), opened.model),
            request,
            asked.options.deadline_ms,
            asked,
        )
        self._metrics.answered(answered.result)
        return answered

    async def do(
        self,
        work: Callable[[Opened], Result],
        request: Request,
        deadline_ms: float | None = None,
        asked: Asked | None = None,
    ) -> Result:
        """Have `work` done with the generation that answers when its turn comes. Raises Problem, and what it raises."""
        self.require_room()
        now = time.monotonic()
        seconds = min(self._settings.deadline_s, (deadline_ms or 1e9) / 1e3)
        answer: asyncio.Future[Result] = asyncio.get_running_loop().create_future()
        self._held += 1
        self._metrics.held.set(self._held)
        answer.add_done_callback(self._let_go)
        self._jobs.put_nowait(_Job(work, asked, answer, now, now + seconds))
        gone: asyncio.Future[None] = asyncio.ensure_future(_gone(request))
        either: set[asyncio.Future[Any]] = {answer, gone}
        try:
            await asyncio.wait(either, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
            if not answer.done():
                left = gone.done()
                self._metrics.dropped.labels("left" if left else "late").inc()
                raise Problem("late", "who asked has left" if left else f"no answer within {1e3 * seconds:g} ms")
            return answer.result()
        finally:
            gone.cancel()
            answer.cancel()

    def _let_go(self, answer: asyncio.Future[Any]) -> None:
        self._held -= 1
        self._metrics.held.set(self._held)
        if not answer.cancelled():
            answer.exception()  # which nobody may be there to ask for

    async def _work(self) -> None:
        while True:
            jobs = [job for job in await self._together() if not job.answer.done()]
            if not jobs:
                continue
            opened, now = self._generations.current, time.monotonic()
            for job in jobs:
                self._metrics.waiting.observe(now - job.began)
            self._metrics.batches.observe(len(jobs))
            loop = asyncio.get_running_loop()
            try:
                answers = await loop.run_in_executor(self._threads, _answers, opened, jobs)
            except Exception as error:  # a bug, which ends no worker
                answers = [error] * len(jobs)
            for job, answer in zip(jobs, answers, strict=True):
                if job.answer.done():
                    continue
                if isinstance(answer, Exception):
                    job.answer.set_exception(answer)
                else:
                    job.answer.set_result(answer)

    async def _together(self) -> list[_Job]:
        """The next job, and what comes within the window that can be answered with it."""
        first, self._next = self._next or await self._jobs.get(), None
        jobs, until = [first], time.monotonic() + self._settings.batch_ms / 1e3
        if not self._settings.batch_ms or first.asked is None:
            return jobs
        while len(jobs) < self._settings.batch_most and (left := until - time.monotonic()) > 0:
            try:
                job = await asyncio.wait_for(self._jobs.get(), left)
            except TimeoutError:
                break
            if self._next or job.asked is None or job.asked.keywords != first.asked.keywords:
                self._next = job
                break
            jobs.append(job)
        return jobs


async def _gone(request: Request) -> None:
    """Ends when the connection does; the body has been read."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _answers(opened: Opened, jobs: list[_Job]) -> list[Any]:
    """The answer of each job, or the exception that is its answer; one bad query spoils no other."""
    if len(jobs) > 1 and (together := _batch(opened, jobs)) is not None:
        return list(together)
    return [_answer(opened, job) for job in jobs]


def _batch(opened: Opened, jobs: list[_Job]) -> list[Answered] | None:
    asked = [job.asked for job in jobs if job.asked is not None]
    try:
        found = opened.searcher.query_many([one.touches for one in asked], **asked[0].keywords)
    except RetrievalError:
        return None
    return [Answered(result, opened.model) for result in found]


def _answer(opened: Opened, job: _Job) -> Any:
    if time.monotonic() > job.deadline:
        return Problem("late", "the deadline passed before the request's turn came")
    try:
        return job.work(opened)
    except Exception as error:
        return error
