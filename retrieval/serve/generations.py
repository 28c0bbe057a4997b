"""Which generation of the index answers: the newest that could be opened. Whoever asks takes `current` once, so that an
answer comes from one generation; the one before is let go of when nobody uses it any more.
"""

import asyncio
import gc
import logging
from functools import cached_property
from threading import Lock

from retrieval.model.checkpoint import Checkpoint, load_checkpoint
from retrieval.search.defaults import manifest_of
from retrieval.search.query.opening import OpenShards
from retrieval.search.query.searcher import Searcher
from retrieval.serve.errors import HttpProblem
from retrieval.serve.metrics import Metrics
from retrieval.serve.settings import ServiceSettings

log = logging.getLogger(__name__)
_RETRY_S = 10.0
"""After which one that could not be opened is tried again."""


class ServedGeneration:
    """A generation that is served: its searcher, and what is made of it when it is first asked for."""

    def __init__(self, searcher: Searcher) -> None:
        self.searcher, self.shard = searcher, searcher.shard
        self.model = searcher.checkpoint.digest
        self.fingers: int = searcher.checkpoint.config.matcher.fingers
        self._lock = Lock()

    @property
    def name(self) -> str:
        """The name of the generation."""
        return self.searcher.info.name

    def checkpoint(self) -> Checkpoint:
        """The whole model, photo tower too, which queries do without."""
        with self._lock:
            return self._checkpoint

    @cached_property
    def _checkpoint(self) -> Checkpoint:
        return load_checkpoint(self.searcher.checkpoint.path, info=self.searcher.checkpoint)


class Generations:
    """The generations of one index folder, or of one cluster, as they come. shards: opens those of a cluster."""

    def __init__(self, settings: ServiceSettings, metrics: Metrics, shards: OpenShards | None = None) -> None:
        self._settings, self._metrics, self._shards = settings, metrics, shards
        self._current: ServedGeneration | None = None

    @property
    def ready(self) -> bool:
        """Whether a generation is open."""
        return self._current is not None

    @property
    def current(self) -> ServedGeneration:
        """What answers now. Raises Problem before anything could be opened."""
        if self._current is None:
            raise HttpProblem("not-ready", "no index is open yet", {"retry-after": "1"})
        return self._current

    def open(self) -> None:
        """Open the newest generation. Raises the errors of `Searcher.open`."""
        settings = self._settings
        generation = ServedGeneration(
            Searcher.open(
                settings.index,
                model=settings.model,
                verify=settings.verify,
                threads=settings.threads,
                shards=self._shards,
            )
        )
        self._current = generation
        self._metrics.set_generation(generation.name)
        gc.collect()  # what the one before held in circles

    async def watch(self) -> None:
        """Take up each new generation. One that cannot be opened is reported, and the old one goes on answering; the
        same failure is reported again after _AGAIN_S.
        """
        failed: str | None = None
        retry_at = 0.0
        while True:
            await asyncio.sleep(self._settings.poll_s)
            now, name = asyncio.get_running_loop().time(), ""  # "": of a manifest that cannot be read
            try:
                name = (await asyncio.to_thread(manifest_of, self._settings.index)).generation
                if name != self.current.name and (name != failed or now >= retry_at):
                    await asyncio.to_thread(self.open)
                    log.warning("generation %s answers from now on", self.current.name)
            except Exception as error:  # whatever is wrong with it
                if name == failed and now < retry_at:
                    continue
                failed, retry_at = name, now + _RETRY_S
                self._metrics.reload_failures.inc()
                log.warning("a new generation cannot be taken up, %s goes on answering: %s", self.current.name, error)
