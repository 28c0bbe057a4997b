"""The served generation of the index: the newest that can be opened.

Each request reads `Generations.current` once, so that its answer comes from one generation. The previous generation is
released when no request uses it.
"""

import asyncio
import gc
import logging

from retrieval.search.opening import OpenShards, manifest_of
from retrieval.search.searcher import Searcher
from retrieval.serve.settings import ServiceSettings

log = logging.getLogger(__name__)
_RETRY_S = 10.0
"""Time after which a generation that failed to open is tried again."""


class Generations:
    """`current`: the searcher of the generation that answers, replaced when a new generation appears."""

    current: Searcher

    def __init__(self, settings: ServiceSettings, shards: OpenShards | None) -> None:
        """Open the newest generation."""
        self._settings, self._shards = settings, shards
        self._open()

    def _open(self) -> None:
        settings = self._settings
        self.current = Searcher.open(
            settings.index, model=settings.model, threads=settings.threads, shards=self._shards
        )
        gc.collect()  # free reference cycles of the previous generation

    async def watch(self) -> None:
        """Open each new generation; if that fails, log it, try again after `_RETRY_S`, and keep the previous one."""
        pause_s = self._settings.poll_s
        while True:
            await asyncio.sleep(pause_s)
            pause_s = self._settings.poll_s
            try:
                manifest = await asyncio.to_thread(manifest_of, self._settings.index)
                # A folder that was deleted and built again counts its generations from 1: compare the contents.
                if manifest != self.current.manifest:
                    await asyncio.to_thread(self._open)
                    log.warning("Generation %s is now served.", self.current.manifest.generation)
            except Exception as error:
                pause_s = _RETRY_S
                log.warning(
                    "A new generation cannot be opened; %s is still served: %s", self.current.manifest.generation, error
                )
