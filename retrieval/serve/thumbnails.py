"""Small pictures of photos; the last ones asked for are kept."""

from collections import OrderedDict
from pathlib import Path
from threading import Lock

from retrieval.report.pages import jpeg, thumbnail

CACHED_BYTES = 32 * 2**20


class Thumbnails:
    """Small JPEG pictures of photo files, kept in memory by the content of the file."""

    def __init__(self, most_bytes: int = CACHED_BYTES) -> None:
        self._kept: OrderedDict[tuple[Path, str, int], bytes] = OrderedDict()
        self._bytes, self._most, self._lock = 0, most_bytes, Lock()

    def of(self, path: Path, digest: str, px: int) -> bytes | None:
        """A JPEG file whose longer side is at most `px`; None where the picture at `path` cannot be read."""
        key = (path, digest, px)
        with self._lock:
            if (found := self._kept.get(key)) is not None:
                self._kept.move_to_end(key)
                return found
        image = thumbnail(path, px)
        if image is None:
            return None
        data = jpeg(image)
        with self._lock:
            if key not in self._kept:
                self._kept[key] = data
                self._bytes += len(data)
            while self._bytes > self._most:
                self._bytes -= len(self._kept.popitem(last=False)[1])
        return data
