"""Who waits for the model, and for how long.

So many requests are held at once, those in work among them; the next is told at once to come again. A request whose
asker has left, or whose deadline has passed, is dropped before it is worked on. Queries that wait and ask alike are
answered together: an encoder takes as long for each as alone, but the interpreter's work is done once for all of them.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from threading import Condition, Thread
from typing import Any, NamedTuple, TypeVar

from starlette.requests import Request

from retrieval.search.query.answer import QueryResult
from retrieval.serve.decoders import Decoders
from retrieval.serve.errors import Problem
from retrieval.serve.generations import Generations, Opened
from retrieval.serve.metrics import Metrics
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.uploads import Asked, Pictures

Result = TypeVar("Result")


class Answered(NamedTuple):
    """An answer, and the digest of the model that gave it."""

    result: QueryResult
    model: str


@dataclass(eq=False)
class _Job:
    """Work for the model, its pictures read. asked: the query, where it is one and nothing else."""

    work: Callable[[Opened], Any]
    asked: Asked | None
    answer: asyncio.Future[Any]
    began: float
    deadline: float


class Queue:
    """Requests that wait for the model, in the order in which they came. The threads that work on them take one after
    the other themselves: none waits for the event loop in between. held: requests that wait or are in work."""

    def __init__(
        self, generations: Generations, settings: ServiceSettings, metrics: Metrics, decoders: Decoders
    ) -> None:
        self._generations, self._settings, self._metrics = generations, settings, metrics
        self._decoders = decoders
        self._jobs: deque[_Job] = deque()
        self._changed, self._closed = Condition(), False
        self._threads: list[Thread] = []
        self.held = 0

    def start(self) -> None:
        """Begin to answer, for the event loop that calls."""
        loop = asyncio.get_running_loop()
        self._threads = [Thread(target=self._work, args=(loop,), daemon=True) for _ in range(self._settings.workers)]
        for thread in self._threads:
            thread.start()

    def close(self, seconds: float) -> None:
        """Answer what waits, and end; work that takes longer than `seconds` is left to itself."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        until = time.monotonic() + seconds
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))

    def require_room(self) -> None:
        """Raises Problem where one more request would not be held; asked before its body is read."""
        if self.held >= self._settings.queue:
            self._metrics.dropped.labels("busy").inc()
            raise Problem(
                "busy",
                f"{self.held} requests are held already; come again",
                {"retry-after": "1", "connection": "close"},
            )

    async def ask(self, asked: Asked, request: Request) -> Answered:
        """Answer a query. Raises Problem, and the errors of `Searcher.query`."""
        answered: Answered = await self.do(
            lambda opened: Answered(opened.searcher.query(asked.pictures.images[0], **asked.keywords), opened.model),
            request,
            asked.options.deadline_ms,
            asked.pictures,
            asked,
        )
        self._metrics.answered(answered.result)
        return answered

    async def do(
        self,
        work: Callable[[Opened], Result],
        request: Request,
        deadline_ms: float | None = None,
        pictures: Pictures | None = None,
        asked: Asked | None = None,
    ) -> Result:
        """Have `pictures` read, and `work` done with the generation that answers when its turn comes. Raises Problem,
        ImageError, and what the work raises."""
        self.require_room()
        now = time.monotonic()
        seconds = min(self._settings.deadline_s, (deadline_ms or 1e9) / 1e3)
        self.held += 1
        self._metrics.held.inc()
        answer = asyncio.ensure_future(self._answer(work, pictures, asked, now, now + seconds))
        answer.add_done_callback(self._let_go)
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

    async def _answer(
        self,
        work: Callable[[Opened], Result],
        pictures: Pictures | None,
        asked: Asked | None,
        began: float,
        deadline: float,
    ) -> Result:
        """Have pictures read, then wait for the model. Cancelling stops both."""
        if pictures is not None:
            px = self._generations.current.searcher.checkpoint.config.preprocessing.touch_px
            images = await self._decoders.read(pictures.named(), px, pictures.background is not None)
            pictures.take(iter(images))
            self._metrics.stages.labels("pictures").observe(time.monotonic() - began)
        answer: asyncio.Future[Result] = asyncio.get_running_loop().create_future()
        job = _Job(work, asked, answer, began, deadline)
        with self._changed:
            self._jobs.append(job)
            self._changed.notify_all()
        try:
            return await answer
        finally:
            with self._changed:
                if job in self._jobs:
                    self._jobs.remove(job)

    def _let_go(self, answer: asyncio.Future[Any]) -> None:
        self.held -= 1
        self._metrics.held.dec()
        if not answer.cancelled():
            answer.exception()  # which nobody may be there to ask for

    def _work(self, loop: asyncio.AbstractEventLoop) -> None:
        while jobs := self._together():
            opened, now = self._generations.current, time.monotonic()
            for job in jobs:
                self._metrics.waiting.observe(now - job.began)
            self._metrics.batches.observe(len(jobs))
            answers = _answers(opened, jobs)
            with suppress(RuntimeError):  # the loop has ended meanwhile
                loop.call_soon_threadsafe(_tell, jobs, answers)

    def _together(self) -> list[_Job]:
        """The next job, and those that wait or come in the window and can be answered with it; none at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._jobs or self._closed)
            if not self._jobs:
                return []
            jobs, until = [first := self._jobs.popleft()], time.monotonic() + self._settings.batch_ms / 1e3
            while first.asked and len(jobs) < self._settings.batch_most:
                if not self._changed.wait_for(lambda: self._jobs, until - time.monotonic()):
                    break
                if not (asked := self._jobs[0].asked) or not asked.goes_with(first.asked):
                    break
                jobs.append(self._jobs.popleft())
            return jobs


async def _gone(request: Request) -> None:
    """Ends when the connection does; the body has been read."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _tell(jobs: list[_Job], answers: list[Any]) -> None:
    for job, answer in zip(jobs, answers, strict=True):
        if job.answer.done():
            continue
        if isinstance(answer, Exception):
            job.answer.set_exception(answer)
        else:
            job.answer.set_result(answer)


def _answers(opened: Opened, jobs: list[_Job]) -> list[Any]:
    """The answer of each job, or the exception that is its answer; one bad query spoils no other."""
    asked = [job.asked for job in jobs if job.asked is not None]
    if len(jobs) > 1:
        with suppress(BaseException):  # else each alone says which of them it was
            found = opened.searcher.query_many([one.pictures.images[0] for one in asked], **asked[0].keywords)
            return [Answered(result, opened.model) for result in found]
    return [_answer(opened, job) for job in jobs]


def _answer(opened: Opened, job: _Job) -> Any:
    if time.monotonic() > job.deadline:
        return Problem("late", "the deadline passed before the request's turn came")
    try:
        return job.work(opened)
    except BaseException as error:
        if isinstance(error, Exception) and not isinstance(error, StopIteration):
            return error
        return RuntimeError(repr(error))  # a future takes no StopIteration, and SystemExit would end the event loop
