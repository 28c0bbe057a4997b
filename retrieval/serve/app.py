"""The application: its parts, put together."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio.to_thread
from fastapi import FastAPI
from pydantic import BaseModel
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from threadpoolctl import threadpool_limits

from retrieval.search.opening import OpenShards
from retrieval.serve import catalogue, errors, health, history, human, live, page_files, queries
from retrieval.serve.decoders import Decoders
from retrieval.serve.generations import Generations
from retrieval.serve.history import FeedbackBody
from retrieval.serve.human import ChoiceBody, NewRun
from retrieval.serve.keeping import Keeping
from retrieval.serve.metrics import Metrics
from retrieval.serve.queries import AgreementBody
from retrieval.serve.queue import Queue
from retrieval.serve.recording import Recorder
from retrieval.serve.security import Guard
from retrieval.serve.service import LiveRig, Service
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.thumbnails import Thumbnails
from retrieval.serve.trials import Trials
from retrieval.serve.uploads import BatchBody, BodyLimit, QueryBody
from retrieval.version import __version__

THREADS = 4
"""That read files and make thumbnails; the model has its own."""
_BODIES: tuple[type[BaseModel], ...] = (
    QueryBody,
    BatchBody,
    AgreementBody,
    FeedbackBody,
    NewRun,
    ChoiceBody,
    errors.ProblemDocument,
)


def create_app(
    settings: ServiceSettings,
    rig: LiveRig | None = None,
    recorder: Recorder | None = None,
    trials: Path | None = None,
    shards: OpenShards | None = None,
) -> FastAPI:
    """The service over the index of `settings`, which is opened when the application starts.

    shards: opens those of a cluster; None: in this process.

    recorder: writes what people said into the recording in the history's folder; nothing is kept without it. trials: a
    recording with whose unseen objects people are tested. Raises BadInput.
    """
    metrics = Metrics()
    generations = Generations(settings, metrics, shards)
    decoders = Decoders()
    parts = Service(
        settings,
        metrics,
        generations,
        decoders,
        Queue(generations, settings, metrics, decoders),
        rig or LiveRig(),
        Thumbnails(),
        Keeping(settings.history, recorder, settings, metrics) if settings.history and recorder else None,
        Trials(trials) if trials else None,
        asyncio.Semaphore(settings.streams),
    )
    app = FastAPI(
        title="touch-retrieval",
        summary="From the gel images of a grasp, find which catalogue photo shows the object in the hand.",
        version=__version__,
        docs_url=None,  # its page loads scripts from elsewhere
        redoc_url=None,
        lifespan=_lifespan,
        separate_input_output_schemas=False,
    )
    app.state.service = parts
    errors.install(app)
    for paths in (queries, catalogue, live, history, human, health):
        app.include_router(paths.router)
    app.include_router(page_files.router_of())
    app.openapi = lambda: _document(app)  # type: ignore[method-assign]
    app.add_middleware(BodyLimit, seconds=settings.body_s)
    app.add_middleware(Guard, settings=settings)
    app.add_middleware(Counted, metrics=metrics)
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    """Opens the index; ends when what is in flight is done, which the server waits for."""
    parts: Service = app.state.service
    anyio.to_thread.current_default_thread_limiter().total_tokens = THREADS
    if not parts.generations.ready:
        await asyncio.to_thread(parts.generations.open)
    parts.queue.start()
    work = [parts.decoders.start(), parts.generations.watch(), *([parts.keeping.work()] if parts.keeping else [])]
    running = [asyncio.ensure_future(one) for one in work]
    try:
        with threadpool_limits(parts.settings.threads, "blas"):  # its threads spin between two queries
            yield
    finally:
        parts.stopping.set()
        if parts.keeping:
            await parts.keeping.written()
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        await asyncio.to_thread(parts.queue.close)
        await parts.decoders.close()
        if parts.keeping:
            parts.keeping.close()


class Counted:
    """Counts responses by status."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app, self.metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and count its response (ASGI)."""

        async def counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                self.metrics.responses.labels(message["status"]).inc()
            await send(message)

        await self.app(scope, receive, counted if scope["type"] == "http" else send)


def _document(app: FastAPI) -> dict[str, Any]:
    """OpenAPI, with the bodies that the paths read themselves."""
    if app.openapi_schema is None:
        document = FastAPI.openapi(app)
        schemas = document.setdefault("components", {}).setdefault("schemas", {})
        for model in _BODIES:
            found = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas |= found.pop("$defs", {})
            schemas[model.__name__] = found
        for name in ("HTTPValidationError", "ValidationError"):  # FastAPI's own words for what are problems here
            schemas.pop(name, None)
        for path in document["paths"].values():
            for operation in path.values():
                if "application/json" in operation["responses"].get("422", {}).get("content", {}):
                    operation["responses"] |= {
                        str(status): said for status, said in errors.problems("bad-input").items()
                    }
        app.openapi_schema = document
    return app.openapi_schema
