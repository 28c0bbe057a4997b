"""Cache of small pictures of photos (least recently used pictures are dropped)."""

from collections import OrderedDict
from pathlib import Path
from threading import Lock

from retrieval.report.pages import jpeg, thumbnail

CACHED_BYTES = 32 * 2**20
"""Default size limit of the cache."""


class Thumbnails:
    """Memory cache of small JPEG pictures, keyed by path, digest and size."""

    def __init__(self, max_bytes: int = CACHED_BYTES) -> None:
        self._cache: OrderedDict[tuple[Path, str, int], bytes] = OrderedDict()
        self._bytes, self._max_bytes, self._lock = 0, max_bytes, Lock()

    def of(self, path: Path, digest: str, px: int) -> bytes | None:
        """Return a small JPEG file of a photo.

        Args:
            path: File of the photo.
            digest: Digest of its content.
            px: Maximum longer side in pixels.

        Returns:
            The JPEG file; None if the photo cannot be read.
        """
        key = (path, digest, px)
        with self._lock:
            if (found := self._cache.get(key)) is not None:
                self._cache.move_to_end(key)
                return found
        image = thumbnail(path, px)
        if image is None:
            return None
        data = jpeg(image)
        with self._lock:
            if key not in self._cache:
                self._cache[key] = data
                self._bytes += len(data)
            while self._bytes > self._max_bytes:
                self._bytes -= len(self._cache.popitem(last=False)[1])
        return data
