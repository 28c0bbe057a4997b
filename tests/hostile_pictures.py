"""Small or empty picture files that take long to decode, for tests and attacks."""

import io
import struct
import zlib

from PIL import Image


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


def jpeg_segment(marker, content):
    return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content


def jpeg_of_scans(side, scans):
    """Return a grey progressive JPEG file; scans after the first have a few bytes and change no coefficient."""
    blocks = (-(-side // 8)) ** 2
    file = b"\xff\xd8" + jpeg_segment(0xDB, b"\0" + b"\1" * 64)
    file += jpeg_segment(0xC2, struct.pack(">BHHB", 8, side, side, 1) + b"\1\x11\0")
    for table, symbol in ((0x00, 0x00), (0x10, 0xE0)):  # one code of one bit: "0"
        file += jpeg_segment(0xC4, bytes([table, 1, *[0] * 15, symbol]))
    runs, left = "", blocks
    while left > 0:  # a run of 16,384 + 14 bits of blocks without coefficients
        runs += "0" + format(max(min(left, 32767) - 16384, 0), "014b")
        left -= 32767
    file += jpeg_segment(0xDA, b"\1\1\0\0\0\0") + _packed("0" * blocks)
    scan = jpeg_segment(0xDA, b"\1\1\0\1\x3f\0") + _packed(runs)
    return file + scan * (scans - 1) + b"\xff\xd9"


def _packed(bits):
    bits += "1" * (-len(bits) % 8)
    return int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\0")


def jpeg_of_segments(count):
    """Return a JPEG file with this number of empty comments, then a picture."""
    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, "JPEG")
    return b"\xff\xd8" + b"\xff\xfe\0\2" * count + file.getvalue()[2:]


def tiff_of_numbers(tag, count):
    """Return a grey TIFF file of 8 x 8 pixels; one tag contains `count` 32-bit numbers."""
    tags = {256: 8, 257: 8, 258: 8, 259: 1, 262: 1, 273: 200, 277: 1, 278: 8, 279: 64, 284: 1}
    entries = {name: (3, 1, value) for name, value in tags.items()} | {tag: (4, count, 300)}
    file = b"II*\0\x08\0\0\0" + struct.pack("<H", len(entries))
    file += b"".join(struct.pack("<HHII", name, *entries[name]) for name in sorted(entries))
    return file.ljust(300, b"\0") + bytes(4 * count)
