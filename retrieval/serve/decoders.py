"""Pictures of requests, decoded in processes of their own.

A decoder in a thread could not be stopped: it would keep a core and its memory until it ends. A process that needs more
processor time or memory than a picture may cost ends itself, and one whose request is over is ended; the next picture
gets a new process. Pictures as small as those of sensors are decoded next to each other; larger ones one at a time, so
that no small one waits for them and their memory does not add up.
"""

import asyncio
import json
import sys
from collections.abc import Sequence
from typing import Any

from retrieval.data.images import MAX_PIXELS
from retrieval.errors import ImageError, RetrievalError
from retrieval.model.gel_images import GelImage, PictureSize
from retrieval.serve.decode_process import DECODE_BYTES, DECODE_CPU_S, LENGTHS, READY, frame, image_of
from retrieval.serve.errors import HttpProblem
from retrieval.serve.settings import MAX_BODY_PIXELS

PROGRAM = "from retrieval.serve.decode_process import serve_pictures; serve_pictures()"
_BUFFER_BYTES = 1 << 20
PROCESSES = 2  # a touch has as many images
SMALL_PIXELS = 1 << 21
"""Of a picture that is decoded next to others; a sensor of 1920 x 1080 pixels has fewer."""


class Decoders:
    """Processes that read the pictures of requests, for the event loop that uses it first."""

    def __init__(self) -> None:
        self._idle: list[_Process] = []
        self._ending: set[asyncio.Task[None]] = set()
        self._small, self._large = asyncio.Semaphore(PROCESSES), asyncio.Semaphore(1)
        self._running: set[asyncio.Task[GelImage | PictureSize]] = set()

    async def start(self) -> None:
        """Start the processes, so that the first query does not wait for them. Raises RetrievalError."""
        self._idle += await asyncio.gather(*(_Process.start() for _ in range(PROCESSES)))

    async def close(self) -> None:
        """End all processes; what is being read fails."""
        for task in self._running:
            task.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)
        idle, self._idle = self._idle, []
        await asyncio.gather(*self._ending, *(process.end() for process in idle))

    async def read(self, named: Sequence[tuple[str, bytes]], px: int, compares_contact: bool) -> list[GelImage]:
        """Read pictures, each with its name, at the sizes of a model whose `touch_px` is px.

        Nothing large is decoded before the sizes of all are known. Raises ImageError for the first picture that cannot
        be used, and Problem for pictures that are too large together.
        """
        small = (self._read_small(name, data, px, compares_contact) for name, data in named)
        found = await asyncio.gather(*small, return_exceptions=True)
        for (name, _), one in zip(named, found, strict=True):
            if isinstance(one, BaseException):
                raise one
            if isinstance(one, PictureSize) and one.pixels > MAX_PIXELS:
                told = f"{one.width} x {one.height} pixels; at most {MAX_PIXELS:,} are taken: send a smaller picture"
                raise ImageError(name, told)
        first = [one for one in found if not isinstance(one, BaseException)]
        total = sum(one.pixels for one in first if isinstance(one, PictureSize))
        if total > MAX_BODY_PIXELS:
            raise HttpProblem(
                "too-large",
                f"the pictures of a request may have {MAX_BODY_PIXELS:,} pixels together; "
                f"the large ones have {total:,}",
            )
        images = []
        for (name, data), one in zip(named, first, strict=True):
            if isinstance(one, PictureSize):
                async with self._large:
                    one = await self._run(name, data, px, compares_contact, MAX_PIXELS)
            assert isinstance(one, GelImage), "of MAX_PIXELS at most"
            images.append(one)
        return images

    async def _read_small(self, name: str, data: bytes, px: int, compares_contact: bool) -> GelImage | PictureSize:
        """A small picture, or the size of a large one. Its process goes on where nobody waits for it any more: it will
        be needed sooner than a new one could start.
        """
        await self._small.acquire()
        task = asyncio.ensure_future(self._run(name, data, px, compares_contact, SMALL_PIXELS))
        self._running.add(task)
        task.add_done_callback(self._release_slot)
        return await asyncio.shield(task)

    def _release_slot(self, task: asyncio.Task[GelImage | PictureSize]) -> None:
        self._running.discard(task)
        self._small.release()

    async def _run(
        self, name: str, data: bytes, px: int, compares_contact: bool, max_pixels: int
    ) -> GelImage | PictureSize:
        """What a process makes of a picture; it is ended where this is cancelled. Raises ImageError, and RetrievalError
        where no process can be started.
        """
        process = self._idle.pop() if self._idle else await _Process.start()
        try:
            document, content = await process.request(
                {"name": name, "px": px, "compares_contact": compares_contact, "max_pixels": max_pixels}, data
            )
            self._idle.append(process)
            return image_of(document, content)
        except (EOFError, ConnectionError, MemoryError):
            raise ImageError(
                name,
                f"decoding it takes more than {DECODE_CPU_S} s of processor time or {DECODE_BYTES // 10**6} MB: "
                "send a smaller picture",
            ) from None
        finally:
            if process not in self._idle:
                task = asyncio.ensure_future(process.end())
                self._ending.add(task)
                task.add_done_callback(self._ending.discard)


class _Process:
    """A process that reads pictures."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    @classmethod
    async def start(cls) -> "_Process":
        """Start one, and wait until it has imported what it needs. Raises RetrievalError."""
        program = f"import sys; sys.path[:] = {sys.path!r}; {PROGRAM}"
        pipe = asyncio.subprocess.PIPE
        try:
            process = cls(
                await asyncio.create_subprocess_exec(
                    sys.executable, "-c", program, stdin=pipe, stdout=pipe, limit=_BUFFER_BYTES
                )
            )
        except OSError as error:
            raise RetrievalError(f"no process can be started that decodes pictures: {error}") from error
        try:
            if (await process._answer())[0] == READY:
                return process
        except EOFError:
            pass
        except BaseException:
            await process.end()
            raise
        await process.end()
        raise RetrievalError("the process that decodes pictures ended as it started; the log of the service says more")

    async def request(self, document: dict[str, Any], content: bytes) -> tuple[dict[str, Any], bytes]:
        """What it answers. Raises EOFError or ConnectionError where it ended."""
        assert self._process.stdin is not None
        self._process.stdin.write(frame(document, content))
        await self._process.stdin.drain()
        return await self._answer()

    async def _answer(self) -> tuple[dict[str, Any], bytes]:
        assert self._process.stdout is not None
        read = self._process.stdout.readexactly
        text, content = LENGTHS.unpack(await read(LENGTHS.size))
        return json.loads(await read(text)), await read(content)

    async def end(self) -> None:
        """End it, whatever it does, and wait until its pipes are closed, too: the event loop may end next."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        if self._process.returncode is None:
            self._process.kill()
        self._process.stdin.close()
        await self._process.stdout.read()
        await self._process.wait()
