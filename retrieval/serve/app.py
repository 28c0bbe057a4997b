"""The application, created from its parts."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import anyio.to_thread
from fastapi import FastAPI
from starlette.staticfiles import StaticFiles
from threadpoolctl import threadpool_limits

from retrieval.search.opening import OpenShards
from retrieval.serve import catalogue, errors, history, queries, security
from retrieval.serve.service import LiveRig, Service
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.store import Recorder
from retrieval.serve.uploads import BodyLimit
from retrieval.version import __version__

THREADS = 4
"""Number of threads that read files and make thumbnails; the model and the rig have other threads."""


def create_app(
    settings: ServiceSettings,
    rig: LiveRig | None = None,
    recorder: Recorder | None = None,
    shards: OpenShards | None = None,
) -> FastAPI:
    """Create the service, and open the index of `settings`.

    Args:
        settings: Options of the operator.
        rig: Sensors and gripper for the live routes; None without live routes.
        recorder: Writes feedback into the recording in the history folder; None without a history.
        shards: Opens the shards of a sharded index; None to open them in this process.

    Raises:
        BadInput: An input cannot be used.
        RetrievalError: The errors of `Searcher.open`.
    """
    app = FastAPI(
        title="touch-retrieval",
        summary="From the gel images of a grasp, find which catalogue photo shows the object in the hand.",
        version=__version__,
        docs_url=None,  # the default page loads scripts from other hosts
        redoc_url=None,
        servers=[{"url": "."}],  # relative to the document, so that a proxy may add a prefix
        lifespan=_lifespan,
        responses=errors.PROBLEM_RESPONSES,
    )
    app.state.service = Service(settings, rig, recorder, shards)
    errors.install_handlers(app)
    for module in (queries, catalogue, history, security):
        app.include_router(module.router)
    app.mount("/", StaticFiles(directory=Path(__file__).parent / "page", html=True))
    app.add_middleware(BodyLimit, seconds=settings.body_s)
    app.add_middleware(security.Guard, settings=settings)
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    """Start the parts; close them after the requests in flight are done."""
    parts: Service = app.state.service
    anyio.to_thread.current_default_thread_limiter().total_tokens = THREADS
    if parts.history_writer:
        await asyncio.to_thread(parts.history_writer.record_pending)
    watching = asyncio.ensure_future(parts.generations.watch())
    try:
        with threadpool_limits(parts.settings.threads, "blas"):  # BLAS threads spin between two queries
            yield
    finally:
        parts.stopping.set()
        watching.cancel()
        parts.decoders.close()
        for queue in (parts.queue, parts.grasps, *parts.frames.values()):
            queue.close()
        if parts.history_writer:
            await asyncio.to_thread(parts.history_writer.store.close)
