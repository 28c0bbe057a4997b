"""What runs in a process of `retrieval.serve.decoders`: it reads one picture after the other from its standard input.

A request and its answer are a frame each: the lengths of a JSON document and of bytes, and both. The module imports
little, for each process pays for it.
"""

import json
import math
import os
import resource
import signal
import struct
import sys
import time
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from retrieval.errors import ImageError
from retrieval.model.fusion_scorer import BLOCKS
from retrieval.model.gel_images import GelImage, PictureSize, read_gel_image

DECODE_CPU_S = 5
"""Processor time of one picture; the slowest one of the most pixels that we could make takes 2 s."""
DECODE_BYTES = 200_000_000
"""Memory of one picture. PNG, JPEG, BMP and TIFF pictures of the most pixels take less, some others more."""
LENGTHS = struct.Struct(">II")
READY: dict[str, Any] = {"ready": True}


def serve_pictures() -> None:
    """Read pictures until standard input ends."""
    for number in (signal.SIGINT, signal.SIGTERM):  # they end the service, which lets its processes finish
        signal.signal(number, signal.SIG_IGN)
    _one_thread()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    answers.write(frame(READY))
    answers.flush()
    while lengths := sys.stdin.buffer.read(LENGTHS.size):
        answers.write(_answer(sys.stdin.buffer, *LENGTHS.unpack(lengths)))
        answers.flush()


def frame(document: dict[str, Any], *contents: bytes | memoryview) -> bytes:
    """A request or an answer."""
    text = json.dumps(document).encode()
    return b"".join((LENGTHS.pack(len(text), sum(map(len, contents))), text, *contents))


def image_of(document: dict[str, Any], content: bytes) -> GelImage | PictureSize:
    """The inverse of an answer. Raises ImageError, and MemoryError where the process had not enough."""
    match document:
        case {"size": size}:
            return PictureSize(*size)
        case {"error": str(reason), "name": str(name)}:
            raise ImageError(name, reason)
        case {"px": int(px), "file_bytes": int(file_bytes)}:
            numbers = np.frombuffer(content, np.float32)
            touch, blocks = np.split(numbers, [px * px * 3])
            shape = (BLOCKS, BLOCKS, 3)
            return GelImage(file_bytes, touch.reshape(px, px, 3), blocks.reshape(shape) if len(blocks) else None)
        case _:
            raise MemoryError


def _answer(requests: BinaryIO, text: int, content: int) -> bytes:
    options, data = json.loads(requests.read(text)), requests.read(content)
    try:
        _limit(resource.RLIMIT_CPU, math.ceil(time.process_time()) + DECODE_CPU_S)
        if sys.platform == "linux":  # elsewhere the system does not hold a process to it
            pages = int(Path("/proc/self/statm").read_text().split()[5])
            _limit(resource.RLIMIT_DATA, pages * resource.getpagesize() + DECODE_BYTES)
        found = read_gel_image(data, **options)
    except ImageError as error:
        if isinstance(error.__cause__, MemoryError):
            return frame({"memory": DECODE_BYTES})
        return frame({"error": error.reason, "name": error.path})
    except MemoryError:
        return frame({"memory": DECODE_BYTES})
    if isinstance(found, PictureSize):
        return frame({"size": found})
    arrays = [found.touch] if found.blocks is None else [found.touch, found.blocks]
    contents = [np.ascontiguousarray(image, np.float32).tobytes() for image in arrays]
    return frame({"px": len(found.touch), "file_bytes": found.file_bytes}, *contents)


def _one_thread() -> None:
    """Decode each picture in one thread: the memory of others counts, too."""
    from PIL import AvifImagePlugin

    AvifImagePlugin.DEFAULT_MAX_THREADS = 1
    try:
        import pillow_heif
    except ImportError:
        return
    pillow_heif.options.DECODE_THREADS = 1


def _limit(what: int, value: int) -> None:
    """Set a soft limit, under the hard one."""
    hard = resource.getrlimit(what)[1]
    resource.setrlimit(what, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
