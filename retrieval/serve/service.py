"""The parts of one service, which all routes share through the application's state."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from threading import Event
from typing import Annotated

from fastapi import Depends, Request

from retrieval.search.opening import OpenShards
from retrieval.serve.decoders import Decoders
from retrieval.serve.generations import Generations
from retrieval.serve.queue import Queue
from retrieval.serve.settings import ServiceSettings
from retrieval.serve.store import HistoryWriter, Recorder

MAX_RIG_GRASPS = 4
"""Maximum number of pending rig grasps, including the one in progress."""
MAX_FRAMES = 16
"""Maximum number of pending requests for the pictures of one sensor."""


@dataclass(frozen=True)
class GraspResult:
    """Result of one grasp.

    Attributes:
        object_id: Name of the grasped object.
        touches: PNG file of each finger's gel image, in finger order.
        background: PNG file of each finger's no-contact frame; None if the rig has none.
        opening_mm: Opening of the jaws that the gripper measures; None if it measures none.
    """

    object_id: str
    touches: list[bytes]
    background: list[bytes] | None = None
    opening_mm: float | None = None


@dataclass(frozen=True)
class LiveRig:
    """Functions of a rig, callable from any thread; they may raise any exception, whose message the user gets.

    Attributes:
        sensors: Name of a sensor -> function that returns its newest picture as a JPEG file.
        grasp: Function that grasps one of the named objects; None if the rig cannot grasp.
    """

    sensors: Mapping[str, Callable[[], bytes]] = field(default_factory=dict)
    grasp: Callable[[list[str]], GraspResult] | None = None


class Service:
    """The parts of one service; the arguments are those of `retrieval.serve.app.create_app`.

    `queue` serves the model, `grasps` the rig's gripper, `frames` each sensor by name; `stopping` is set at shutdown.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        rig: LiveRig | None,
        recorder: Recorder | None,
        shards: OpenShards | None,
    ) -> None:
        self.settings, self.rig = settings, rig or LiveRig()
        self.generations, self.decoders = Generations(settings, shards), Decoders()
        queue = partial(Queue, self.generations, decoders=self.decoders)
        self.queue = queue(settings)
        self.grasps = queue(replace(settings, queue=MAX_RIG_GRASPS))
        self.frames = {name: queue(replace(settings, queue=MAX_FRAMES)) for name in self.rig.sensors}
        self.history_writer = None
        if settings.history and recorder:
            self.history_writer = HistoryWriter(settings.history, recorder)
        self.stopping = Event()


async def _service(request: Request) -> Service:  # async, because FastAPI calls plain functions in a thread
    return request.app.state.service  # type: ignore[no-any-return]


Parts = Annotated[Service, Depends(_service)]
"""Type of a route's parameter that receives the service."""
