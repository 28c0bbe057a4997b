"""Image decoding for requests, in threads, whose decoders release the GIL.

Small pictures, such as those of sensors, are decoded in parallel. Large ones are decoded one at a time, so that small
ones do not wait for them and their memory does not add up. The number of threads bounds this also for pictures of
requests that have ended.
"""

import asyncio
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from retrieval.data.images import check_pixels, decode, picture_size
from retrieval.data.resize import resize
from retrieval.model.touches import GelImage
from retrieval.serve.errors import HttpProblem
from retrieval.serve.settings import MAX_BODY_PIXELS

THREADS = 2  # the number of images of a touch
SMALL_PIXELS = 1 << 21
"""Maximum pixels of a picture that is decoded in parallel; a sensor of 1920 x 1080 pixels has fewer."""


class Decoders:
    """Threads that decode the pictures of requests."""

    def __init__(self) -> None:
        self._small, self._large = ThreadPoolExecutor(THREADS), ThreadPoolExecutor(1)

    def close(self) -> None:
        """Drop the waiting pictures."""
        for threads in (self._small, self._large):
            threads.shutdown(wait=False, cancel_futures=True)

    async def read(self, named_files: Sequence[tuple[str, bytes]], px: int) -> list[GelImage]:
        """Decode pictures, each given by its name and file, to `px` x `px` pixels.

        They are decoded only after the sizes of all pictures are known.

        Raises:
            ImageError: A picture cannot be used; the first one is reported.
            HttpProblem: The pictures are too large together.
        """
        loop = asyncio.get_running_loop()
        sizes = await loop.run_in_executor(self._small, lambda: [_pixels(data, name) for name, data in named_files])
        if (total := sum(size for size in sizes if size > SMALL_PIXELS)) > MAX_BODY_PIXELS:
            raise HttpProblem(
                "too-large",
                f"The pictures of a request may have {MAX_BODY_PIXELS:,} pixels in total; "
                f"the large ones have {total:,}.",
            )
        threads = [self._small if size <= SMALL_PIXELS else self._large for size in sizes]
        works = [
            loop.run_in_executor(pool, read_gel_image, data, name, px)
            for pool, (name, data) in zip(threads, named_files, strict=True)
        ]
        images = await asyncio.gather(*works, return_exceptions=True)
        for image in images:
            if isinstance(image, BaseException):
                raise image
        return [image for image in images if isinstance(image, GelImage)]


def _pixels(data: bytes, name: str) -> int:
    """Return the number of pixels in a picture's header. Raises ImageError for too many, or for no picture."""
    size = picture_size(data, name)
    check_pixels(size, name)
    return math.prod(size)


def read_gel_image(data: bytes, name: str, px: int) -> GelImage:
    """Decode a picture and resize it to `px` x `px` pixels. Raises ImageError."""
    return GelImage(resize(decode(data, name), (px, px)), data)
