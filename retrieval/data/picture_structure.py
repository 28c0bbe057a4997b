"""Bounds on the structure of a picture file, checked before decoding.

The size of a file does not bound the work. A JPEG file of 1.5 MB can contain 40,000 scans, and each scan
processes all pixels. A PNG file of 19 MB can contain 1.6 million empty chunks, and Pillow parses each one in Python.
Every check here takes time in proportion to the file, most of it in C.
"""

import re
import struct
from pathlib import Path

from retrieval.errors import ImageError

MAX_SCANS = 50
"""Maximum number of scans of a JPEG file; encoders write 1 to 20."""
MAX_SEGMENTS = 256
"""Maximum number of segments (JPEG) or chunks (PNG) before the pixels of a file: 16 MB at 64 kB each."""
MAX_STRAY_BYTES = 1 << 16
"""Maximum number of bytes between the segments before a JPEG file's pixels; Pillow reads them one by one."""
BYTES_PER_CHUNK = 1024
"""Smallest mean size of a PNG chunk after the first MAX_SEGMENTS chunks. Encoders write 8 kB or more."""
MAX_TIFF_TAGS = 1000
MAX_TIFF_NUMBERS = 500_000
"""Maximum number of values (such as offsets of strips) in all tags together: 20 million pixels in tiles of 16 x 16 need
156,250."""

_JPEG, _PNG, _SCAN = b"\xff\xd8", b"\x89PNG\r\n\x1a\n", 0xDA
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xDA)})
_TIFF_ORDERS = {b"II": "<", b"MM": ">"}
_TIFF_TEXT, _TIFF_BYTES, _TIFF_EXTENSIONS = 2, frozenset({1, 6, 7}), 340
"""Types of tags; and the first tag that decoders do not parse as numbers when it contains bytes."""


def check_structure(data: bytes, name: str | Path) -> None:
    """Raise ImageError if a picture file, called `name`, has too many scans, segments, chunks or tags."""
    if data.startswith(_JPEG):
        _check_jpeg(data, name)
    elif data.startswith(_PNG):
        _check_png(data, name)
    elif data[:2] in _TIFF_ORDERS:
        _check_tiff(data, name)


def _check_jpeg(data: bytes, name: str | Path) -> None:
    start, stray = len(_JPEG), 0
    for _ in range(MAX_SEGMENTS):
        found = _MARKER.search(data, start, start + MAX_STRAY_BYTES + 2)
        stray += (found.start() if found else len(data)) - start
        if stray > MAX_STRAY_BYTES:
            raise ImageError(name, f"more than {MAX_STRAY_BYTES} stray bytes between its JPEG segments; save it again")
        if found is None:
            return  # the decoder reports this
        if data[found.end() - 1] == _SCAN:
            break
        start = _after_segment(data, found.end())
    else:
        raise ImageError(name, f"more than {MAX_SEGMENTS} JPEG segments before its pixels; save it without metadata")
    if data.count(b"\xff\xda") > MAX_SCANS and _count_scans(data, start) > MAX_SCANS:
        raise ImageError(name, f"more than {MAX_SCANS} JPEG scans; save it as a baseline JPEG")


def _count_scans(data: bytes, start: int) -> int:
    """Return the number of scans from `start` to the end of the picture; later bytes (such as a video) are ignored."""
    scans = 0
    for _ in range(MAX_SCANS * MAX_SEGMENTS):
        found = _MARKER.search(data, start)
        if found is None or data[found.end() - 1] == 0xD9:
            return scans
        scans += data[found.end() - 1] == _SCAN
        if scans > MAX_SCANS:
            return scans
        start = _after_segment(data, found.end())
    return MAX_SCANS + 1  # no encoder writes so many segments between scans


def _after_segment(data: bytes, start: int) -> int:
    """Return the end of the segment whose marker ends at `start`."""
    if data[start - 1] in _WITHOUT_LENGTH:
        return start
    return start + max(int.from_bytes(data[start : start + 2], "big"), 2)


def _check_png(data: bytes, name: str | Path) -> None:
    start, chunks, kind, most = len(_PNG), 0, b"", MAX_SEGMENTS
    while start + 12 <= len(data) and kind != b"IEND":
        kind = data[start + 4 : start + 8]
        if kind == b"IDAT":
            most = MAX_SEGMENTS + len(data) // BYTES_PER_CHUNK
        if chunks == most:
            raise ImageError(name, f"more than {most} PNG chunks; save it again without metadata")
        start += 12 + int.from_bytes(data[start : start + 4], "big")
        chunks += 1


def _check_tiff(data: bytes, name: str | Path) -> None:
    order, big = _TIFF_ORDERS[data[:2]], data[2:4] in (b"\x2b\0", b"\0\x2b")
    try:
        (start,) = struct.unpack_from(f"{order}{'Q' if big else 'L'}", data, 8 if big else 4)
        (tags,) = struct.unpack_from(f"{order}{'Q' if big else 'H'}", data, start)
        if tags > MAX_TIFF_TAGS:
            raise ImageError(name, f"{tags} TIFF tags; at most {MAX_TIFF_TAGS} are read: save it without metadata")
        start, entry = start + (8 if big else 2), struct.Struct(f"{order}HH{'QQ' if big else 'LL'}")
        numbers = 0
        for number in range(tags):
            tag, kind, count, _ = entry.unpack_from(data, start + number * entry.size)
            if kind != _TIFF_TEXT and (tag < _TIFF_EXTENSIONS or kind not in _TIFF_BYTES):
                numbers += count
    except struct.error:
        return  # truncated; the decoder reports it
    if numbers > MAX_TIFF_NUMBERS:
        raise ImageError(
            name, f"{numbers} numbers in its TIFF tags; at most {MAX_TIFF_NUMBERS} are read: save it in larger strips"
        )
