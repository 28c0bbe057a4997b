"""What the paths share: the parts of one service, which stand in the application's state."""

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
from retrieval.serve.thumbnails import Thumbnails
from retrieval.serve.trials import Trials


@dataclass(frozen=True)
class GraspResult:
    """What a rig felt: the name of the object, and PNG files of the fingers, in their order; of the untouched gels
    where the rig has seen them.
    """

    object_id: str
    touches: list[bytes]
    background: list[bytes] | None = None


@dataclass(frozen=True)
class LiveRig:
    """What a rig gives the service (`retrieval.serve.rig`), as callables that may be asked from any thread.

    sensors: name -> the newest picture as a JPEG file. grasp: closes jaws on one of the objects of these names; None
    where nothing can be closed. Both may raise anything; the sentence is shown.
    """

    sensors: Mapping[str, Callable[[], bytes]] = field(default_factory=dict)
    grasp: Callable[[list[str]], GraspResult] | None = None


@dataclass(frozen=True, eq=False)
class Service:
    """The parts of one service. grasps: the queue of the rig; frames: one for each sensor, by name. streams: places for
    live pictures. stopping: set when it is to end, for what would never end by itself.
    """

    settings: ServiceSettings
    metrics: Metrics
    generations: Generations
    decoders: Decoders
    queue: Queue
    grasps: Queue
    frames: Mapping[str, Queue]
    rig: LiveRig
    thumbnails: Thumbnails
    history_writer: HistoryWriter | None
    trials: Trials | None
    streams: Semaphore
    stopping: Event = field(default_factory=Event)


async def _service(request: Request) -> Service:  # what is no coroutine function is called in a thread
    found: Service = request.app.state.service
    return found


Parts = Annotated[Service, Depends(_service)]
"""A parameter of a path that wants the service."""
