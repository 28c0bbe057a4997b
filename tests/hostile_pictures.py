"""Small picture files of many pixels, for tests and attacks."""

import struct
import zlib


def png_chunk(kind, content):
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_file(width, height, *chunks, samples=b""):
    """Return a PNG file with these sides in its header and extra chunks before its pixels; RGB, 8 bits."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    pixels = png_chunk(b"IDAT", zlib.compress(samples, 9))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + pixels + png_chunk(b"IEND", b"")


def png_of_zeros(width, height):
    """Return a complete black PNG file."""
    return png_file(width, height, samples=bytes((3 * width + 1) * height))
