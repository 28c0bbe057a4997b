"""What runs in a process of `retrieval.serve.decoders`; it imports little, for each process pays for it."""

import math
import os
import resource
import signal
import sys
import time
from functools import cache
from pathlib import Path

from retrieval.errors import ImageError
from retrieval.model.gel_images import GelImage, PictureSize, read_gel_image

DECODE_CPU_S = 5
"""Processor time of one picture; the slowest one of the most pixels that we could make takes 2 s."""
DECODE_BYTES = 200_000_000
"""Memory of one picture. PNG, JPEG, BMP and TIFF pictures of the most pixels take less, some others more."""
NICENESS = 5
"""Of the process, so that the event loop goes first where cores are short."""


@cache
def begin() -> None:
    """Become a process that decodes: one thread, and not ended by the signals that end the service, which lets it
    finish."""
    os.nice(NICENESS)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    from PIL import AvifImagePlugin

    AvifImagePlugin.DEFAULT_MAX_THREADS = 1
    try:
        import pillow_heif
    except ImportError:
        return
    pillow_heif.options.DECODE_THREADS = 1


def read_within_limits(data: bytes, name: str, px: int, compares: bool, most: int) -> GelImage | PictureSize:
    """As `read_gel_image`, in a process that ends itself after DECODE_CPU_S. Raises ImageError, and MemoryError beyond
    DECODE_BYTES."""
    begin()
    _limit(resource.RLIMIT_CPU, math.ceil(time.process_time()) + DECODE_CPU_S)
    if sys.platform == "linux":  # elsewhere the system does not hold a process to it
        pages = int(Path("/proc/self/statm").read_text().split()[5])
        _limit(resource.RLIMIT_DATA, pages * resource.getpagesize() + DECODE_BYTES)
    try:
        return read_gel_image(data, name, px, compares, most)
    except MemoryError:
        raise MemoryError from None
    except ImageError as error:
        if isinstance(error.__cause__, MemoryError):
            raise MemoryError from None
        raise


def _limit(what: int, value: int) -> None:
    """Set a soft limit, under the hard one."""
    hard = resource.getrlimit(what)[1]
    resource.setrlimit(what, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
