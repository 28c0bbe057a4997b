"""The parts of one service, which all routes share through the application's state."""

from asyncio import Semaphore
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from threading import Event
from typing import Annotated

from fastapi import Depends, Request

from retrieval.serve.decoders import Decoders
from retrieval.serve.generations import Generations
from retrieval.serve.history_writer import HistoryWriter as HistoryWriter
from retrieval.serve.metrics import Metrics
from retrieval.serve.queue import Queue
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.trials import Trials


@dataclass(frozen=True)
class GraspResult:
    """Result of one grasp.

    Attributes:
        object_id: Name of the grasped object.
        touches: PNG file of each finger's gel image, in finger order.
        background: PNG file of each finger's no-contact frame; None if the rig has none.
    """

    object_id: str
    touches: list[bytes]
    background: list[bytes] | None = None


@dataclass(frozen=True)
class LiveRig:
    """Functions of a rig (`retrieval.serve.rig`), callable from any thread.

    Both may raise any exception; the user gets its message.

    Attributes:
        sensors: Name of a sensor -> function that returns its newest picture as a JPEG file.
        grasp: Function that grasps one of the named objects; None if the rig cannot grasp.
    """

    sensors: Mapping[str, Callable[[], bytes]] = field(default_factory=dict)
    grasp: Callable[[list[str]], GraspResult] | None = None


@dataclass(frozen=True, eq=False)
class Service:
    """The parts of one service.

    Attributes:
        settings: Options of the operator.
        metrics: Prometheus metrics.
        generations: The served generation of the index.
        decoders: Processes that decode pictures.
        queue: Queue of the model.
        grasps: Queue of the rig's gripper.
        frames: Queue of each sensor, by name.
        rig: Functions of the live rig.
        history_writer: Writer of the history; None if no history is stored.
        trials: Trials of the human baseline; None if there is no recording for them.
        streams: Limits the number of live streams.
        stopping: Set at shutdown, to end streams.
    """

    settings: ServiceSettings
    metrics: Metrics
    generations: Generations
    decoders: Decoders
    queue: Queue
    grasps: Queue
    frames: Mapping[str, Queue]
    rig: LiveRig
    history_writer: HistoryWriter | None
    trials: Trials | None
    streams: Semaphore
    stopping: Event = field(default_factory=Event)


async def _service(request: Request) -> Service:  # async, because FastAPI calls plain functions in a thread
    found: Service = request.app.state.service
    return found


Parts = Annotated[Service, Depends(_service)]
"""Type of a route's parameter that receives the service."""
