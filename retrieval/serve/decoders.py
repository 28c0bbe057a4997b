"""Image decoding for requests, in separate processes.

A decoder in a thread cannot be stopped: it occupies a core and its memory until it ends. A decoder process ends itself
if a picture exceeds the limits of CPU time or memory, and the service kills the process of a finished request. The next
picture gets a new process. Small pictures, such as those of sensors, are decoded in parallel; large ones one at a time,
so that small ones do not wait for them and their memory does not add up.

A request to a process, and its answer, are a JSON document and a byte string. This module imports little, because each
process repeats the imports.
"""

import asyncio
import json
import math
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

import numpy as np

from retrieval.data.images import MAX_PIXELS, check_pixels, decode, picture_size
from retrieval.data.resize import RgbImage, resize
from retrieval.errors import ImageError, RetrievalError
from retrieval.model.touches import GelImage
from retrieval.serve.settings import MAX_BODY_PIXELS

PROGRAM = "from retrieval.serve.decoders import serve_pictures; serve_pictures()"
PROCESSES = 2  # the number of images of a touch
SMALL_PIXELS = 1 << 21
"""Maximum pixels of a picture that is decoded in parallel; a sensor of 1920 x 1080 pixels has fewer."""
DECODE_CPU_S = 5
"""Maximum CPU time for one picture. The slowest picture of maximum size that we could construct takes 2 s."""
DECODE_BYTES = 200_000_000
"""Maximum memory for one picture. PNG, JPEG, BMP and TIFF pictures of maximum size need less, some formats more."""


class Decoders:
    """Processes that decode the pictures of requests; bound to the event loop of the first use."""

    def __init__(self) -> None:
        self._idle: list[_Process] = []
        self._ending: set[asyncio.Task[None]] = set()
        self._small, self._large = asyncio.Semaphore(PROCESSES), asyncio.Semaphore(1)

    async def start(self) -> None:
        """Start the processes, so that the first query does not wait for them. Raises RetrievalError."""
        self._idle += [_Process() for _ in range(PROCESSES)]
        await asyncio.gather(*(asyncio.to_thread(process.wait_until_ready) for process in self._idle))

    async def close(self) -> None:
        """End the processes; those of requests end with them."""
        idle, self._idle = self._idle, []
        await asyncio.gather(*self._ending, *(asyncio.to_thread(process.end) for process in idle))

    async def read(self, named_files: Sequence[tuple[str, bytes]], px: int) -> list[GelImage]:
        """Decode pictures, each given by its name and file, to `px` x `px` pixels.

        Large pictures are decoded only after the sizes of all pictures are known.

        Raises:
            ImageError: A picture cannot be used; the first one is reported.
            HttpProblem: The pictures are too large together.
        """

        async def read_small(name: str, data: bytes) -> GelImage | int:
            async with self._small:
                return await self._run(name, data, px, SMALL_PIXELS)

        first = await asyncio.gather(*(read_small(*one) for one in named_files), return_exceptions=True)
        for one in first:
            if isinstance(one, BaseException):
                raise one
        total = sum(one for one in first if isinstance(one, int))
        if total > MAX_BODY_PIXELS:
            from retrieval.serve.errors import HttpProblem  # slow to import

            raise HttpProblem(
                "too-large",
                f"The pictures of a request may have {MAX_BODY_PIXELS:,} pixels in total; "
                f"the large ones have {total:,}.",
            )
        images = []
        for (name, data), found in zip(named_files, first, strict=True):
            if isinstance(found, int):
                async with self._large:
                    found = await self._run(name, data, px, MAX_PIXELS)
            assert isinstance(found, GelImage), "the picture has at most MAX_PIXELS"
            images.append(found)
        return images

    async def _run(self, name: str, data: bytes, px: int, max_pixels: int) -> GelImage | int:
        """Decode a picture in a process, or return the number of its pixels if that is above `max_pixels`.

        Cancelling ends the process. Raises ImageError or RetrievalError.
        """
        process = self._idle.pop() if self._idle else _Process()
        try:
            options = {"name": name, "px": px, "max_pixels": max_pixels}
            document, content = await asyncio.to_thread(process.request, options, data)
            self._idle.append(process)
        except (EOFError, OSError):
            raise ImageError(
                name,
                f"decoding needs more than {DECODE_CPU_S} s of CPU time or {DECODE_BYTES // 10**6} MB: "
                "send a smaller picture",
            ) from None
        finally:
            if process not in self._idle:
                task = asyncio.create_task(asyncio.to_thread(process.end))
                self._ending.add(task)
                task.add_done_callback(self._ending.discard)
        if "error" in document:
            raise ImageError(document["name"], document["error"])
        if document:
            return int(document["pixels"])
        return GelImage(np.frombuffer(content, np.float32).reshape(px, px, 3), data)


class _Process:
    """A decoder process; its methods wait for it."""

    def __init__(self) -> None:
        program = f"import sys; sys.path[:] = {sys.path!r}; {PROGRAM}"
        self._pipe, theirs = Pipe()
        line = [sys.executable, "-c", program, str(theirs.fileno())]
        try:
            # Output of libraries goes to standard error.
            self._process = subprocess.Popen(line, stdout=2, pass_fds=[theirs.fileno()])
        except OSError as error:
            raise RetrievalError(f"The image decoder process cannot be started: {error}") from error
        finally:
            theirs.close()
        self._is_ready = False

    def wait_until_ready(self) -> None:
        """Wait until the imports of the process are done, or raise RetrievalError."""
        if not self._is_ready:
            try:
                self._pipe.recv_bytes()
            except (EOFError, OSError) as error:
                raise RetrievalError("The image decoder process ended during its start.") from error
            self._is_ready = True

    def request(self, document: dict[str, Any], content: bytes) -> tuple[dict[str, Any], bytes]:
        """Send a request and return the answer; raises EOFError or OSError if the process ends."""
        self.wait_until_ready()
        self._pipe.send_bytes(json.dumps(document).encode())
        self._pipe.send_bytes(content)
        return json.loads(self._pipe.recv_bytes()), self._pipe.recv_bytes()

    def end(self) -> None:
        """Kill the process; a thread that waits for its answer gets EOFError."""
        self._process.kill()
        self._process.wait()


# The process -----------------------------------------------------------------------------------------------------


def serve_pictures() -> None:
    """Decode pictures until the pipe, whose number is the process's argument, is closed."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the service handles them and ends its processes
        signal.signal(number, signal.SIG_IGN)
    _one_thread()
    pipe = Connection(int(sys.argv[1]))
    pipe.send_bytes(b"")  # the imports are done
    while True:
        try:
            options, data = json.loads(pipe.recv_bytes()), pipe.recv_bytes()
        except EOFError:
            return
        document, content = _answer(options, data)
        pipe.send_bytes(json.dumps(document).encode())
        pipe.send_bytes(content)


def read_gel_image(data: bytes, name: str, px: int, max_pixels: int) -> RgbImage | int:
    """Decode and resize a picture, or return the number of its pixels if that is above `max_pixels`.

    Raises:
        ImageError: The file is not a readable picture.
    """
    width, height = picture_size(data, name)
    check_pixels((width, height), name)
    return resize(decode(data, name), (px, px)) if width * height <= max_pixels else width * height


def _answer(options: dict[str, Any], data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the answer to a request; the process ends if a picture needs too much memory."""
    _limit(resource.RLIMIT_CPU, math.ceil(time.process_time()) + DECODE_CPU_S)
    if sys.platform == "linux":  # other systems do not enforce the limit
        pages = int(Path("/proc/self/statm").read_text().split()[5])
        _limit(resource.RLIMIT_DATA, pages * resource.getpagesize() + DECODE_BYTES)
    try:
        found = read_gel_image(data, **options)
    except ImageError as error:
        if isinstance(error.__cause__, MemoryError):
            raise SystemExit(1) from error
        return {"error": error.reason, "name": error.path}, b""
    return ({"pixels": found}, b"") if isinstance(found, int) else ({}, found.tobytes())


def _one_thread() -> None:
    """Decode each picture in one thread, because the memory of further threads counts towards the limit."""
    from PIL import AvifImagePlugin

    AvifImagePlugin.DEFAULT_MAX_THREADS = 1
    try:
        import pillow_heif
    except ImportError:
        return
    pillow_heif.options.DECODE_THREADS = 1


def _limit(kind: int, value: int) -> None:
    """Set a soft resource limit, capped by the hard limit."""
    hard = resource.getrlimit(kind)[1]
    resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
