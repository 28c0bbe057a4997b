"""Worker process of `retrieval.serve.decoders`: it decodes pictures from its standard input, one after the other.

A request and its answer are one frame each: the lengths of a JSON document and of a byte string, then both. The module
imports little, because each process repeats the imports.
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
from retrieval.model.gel_check import BLOCKS
from retrieval.model.gel_images import GelImage, PictureSize, read_gel_image

DECODE_CPU_S = 5
"""Maximum CPU time for one picture. The slowest picture of maximum size that we could construct takes 2 s."""
DECODE_BYTES = 200_000_000
"""Maximum memory for one picture. PNG, JPEG, BMP and TIFF pictures of maximum size need less, some formats more."""
LENGTHS = struct.Struct(">II")
READY: dict[str, Any] = {"ready": True}


def serve_pictures() -> None:
    """Decode pictures until standard input ends."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the service handles them and ends its processes
        signal.signal(number, signal.SIG_IGN)
    _one_thread()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # keep output of libraries out of the answers
    answers.write(frame(READY))
    answers.flush()
    while lengths := sys.stdin.buffer.read(LENGTHS.size):
        answers.write(_answer(sys.stdin.buffer, *LENGTHS.unpack(lengths)))
        answers.flush()


def frame(document: dict[str, Any], *contents: bytes | memoryview) -> bytes:
    """Return a request or an answer as bytes."""
    text = json.dumps(document).encode()
    return b"".join((LENGTHS.pack(len(text), sum(map(len, contents))), text, *contents))


def image_of(document: dict[str, Any], content: bytes) -> GelImage | PictureSize:
    """Return the picture, or the picture's size, from an answer.

    Raises:
        ImageError: The picture cannot be decoded.
        MemoryError: The process ran out of memory.
    """
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
        if sys.platform == "linux":  # other systems do not enforce the limit
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
