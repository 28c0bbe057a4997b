"""Decode picture files to float32 RGB in 0..1.

Pillow reads and checks every file. (OpenCV fills the missing part of a truncated JPEG with grey, without an error.) Of
16-bit colour Pillow keeps the high byte; 16-bit grey keeps all bits. Colour profiles and gamma chunks are not applied.
"""

import io
import struct
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError, features

from _touch_retrieval.files import read_regular
from retrieval.data.picture_structure import check_structure
from retrieval.data.resize import RgbImage, Samples, to_unit
from retrieval.errors import BadInput, ImageError

HEIC_EXTENSIONS = frozenset({".heic", ".heif", ".hif"})
AVIF_EXTENSIONS = frozenset({".avif"})
_AVIF_BRANDS = frozenset({b"avif", b"avis"})
_HEIC_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
EXTENSIONS = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"}) | AVIF_EXTENSIONS | HEIC_EXTENSIONS
MAX_PIXELS = 20_000_000
"""Maximum pixels of a decoded picture: 240 MB in float32. Larger JPEG files are decoded at 1/2, 1/4 or 1/8 size."""
MAX_DRAFT_PIXELS = 160_000_000
"""Maximum pixels of a JPEG file that is decoded at a smaller size."""
MAX_SIDE, MAX_ASPECT = 65_535, 200
"""Largest side in pixels (the limit of JPEG), and largest ratio of the longer to the shorter side."""
MAX_BYTES = 512 * 2**20

_FORMATS = ("BMP", "JPEG", "PNG", "TIFF", "WEBP")
_NO_IMAGE = "not a PNG, JPEG, BMP, TIFF, WebP, AVIF or HEIC picture, or its header is damaged or of an unsupported kind"
_EIGHT_BIT_MODES = frozenset({"1", "L", "P", "RGB", "RGBX", "CMYK", "YCbCr", "LA", "PA", "RGBA", "RGBa"})
_STRIP = 1 << 20  # pixels
_ORIENTATION, _BITS, _PHOTOMETRIC = 274, 258, 262


class _SuppressedWarnings:
    """Context manager that suppresses warnings while any thread is inside.

    Warning filters belong to the whole process. With `warnings.catch_warnings` in each thread, threads could restore
    the filters in the wrong order. A lock around it would decode one picture at a time.
    """

    def __init__(self) -> None:
        self._lock, self._inside, self._filters = threading.Lock(), 0, warnings.catch_warnings()

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._filters = warnings.catch_warnings()
                self._filters.__enter__()
                warnings.simplefilter("ignore")
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._filters.__exit__(None, None, None)


_suppressed_warnings = _SuppressedWarnings()


_DRAFT_SCALES = (8, 4, 2)


def read_rgb(path: str | Path) -> RgbImage:
    """Read the picture at `path` as (H, W, 3) float32 RGB in 0..1, upright.

    Raises:
        ImageError: The file cannot be read or decoded.
    """
    return decode_rgb(read_bytes(path), path)


def read_bytes(path: str | Path) -> bytes:
    """Return the bytes of a regular file of at most MAX_BYTES.

    Raises:
        ImageError: The file cannot be read.
    """
    try:
        return read_regular(path, MAX_BYTES)
    except FileNotFoundError:
        raise ImageError(path, "no such file") from None
    except IsADirectoryError:
        raise ImageError(path, "is a folder; name a picture file") from None
    except (OSError, ValueError, MemoryError) as error:
        raise ImageError(path, f"cannot be read: {_reason(error)}") from error


def decode_rgb(data: bytes, name: str | Path, min_side: int | None = None) -> RgbImage:
    """Decode one picture to (H, W, 3) float32 RGB in 0..1.

    Grey becomes three equal channels, transparency is composited on white, and the EXIF orientation is applied. Of
    several pages or frames, the first is decoded.

    Args:
        data: Bytes of the file.
        name: Name of the picture in messages.
        min_side: A JPEG file is decoded at 1/8, 1/4 or 1/2 of its size by its cosine transform, as long as the shorter
            side keeps this many pixels; each pixel is then nearly the mean of its area. None to decode only pictures
            smaller that are too large.

    Raises:
        ImageError: The bytes are not a picture that can be decoded.
    """
    return to_unit(decode(data, name, min_side))


def decode(data: bytes, name: str | Path, min_side: int | None = None) -> Samples:
    """Decode like `decode_rgb`, but return (H, W, 3) uint8 for an opaque picture of 8 bits.

    Args:
        data: Bytes of the file.
        name: Name of the picture in messages.
        min_side: As for `decode_rgb`.
    """
    with _open_image(data, name) as image:
        _apply_draft_mode(image, min_side)
        check_pixels(image.size, name)
        image.load()
        samples = _deep_grey(image, name) if image.mode.startswith("I;16") else _eight_bit_rgb(image, name)
        return _apply_orientation(samples, _orientation(image))


def picture_size(data: bytes, name: str | Path) -> tuple[int, int]:
    """Return (width, height) from a picture's header, without decoding.

    Raises:
        ImageError: As for `decode_rgb`.
    """
    if (size := _webp_size(data)) != (1, 1):
        return size
    with _open_image(data, name) as image:
        width, height = image.size
        return width, height


@contextmanager
def _open_image(data: bytes, name: str | Path) -> Iterator[Image.Image]:
    """Open a picture and read its header; errors here and in the `with` block become ImageError."""
    if not data:
        raise ImageError(name, "the file is empty")
    try:
        check_pixels(_webp_size(data), name)
        check_structure(data, name)
        decoder = _register_decoder(data, name)
        with _suppressed_warnings:
            try:
                image = Image.open(io.BytesIO(data), formats=_FORMATS if decoder is None else (decoder,))
            except Image.DecompressionBombError:
                raise ImageError(name, _too_large("far more")) from None
            with image:
                yield image
    except ImageError:
        raise
    except UnidentifiedImageError:
        raise ImageError(name, _NO_IMAGE) from None
    except Exception as error:  # OSError, SyntaxError, struct.error, cv2.error, MemoryError, ...
        raise ImageError(name, f"damaged or truncated: {_reason(error)}") from error


def to_float(image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Scale uint8 or uint16 samples of any shape to float32 in 0..1.

    Raises:
        BadInput: The samples have another type.
    """
    if image.dtype not in (np.uint8, np.uint16):
        raise BadInput(f"samples must be uint8 or uint16, got {image.dtype}")
    scaled = np.divide(image, np.iinfo(image.dtype).max, dtype=np.float32)
    return cast(npt.NDArray[np.float32], scaled)


def _reason(error: BaseException) -> str:
    text = getattr(error, "strerror", None) or str(error) or "no reason given"
    return f"{' '.join(text.split())} ({type(error).__name__})"


def _register_decoder(data: bytes, name: str | Path) -> str | None:
    """Register the decoder of HEIF or AVIF bytes with Pillow and return its name; None for any other picture.

    Both kinds of file begin with a box of type "ftyp" that lists their brands. Raises ImageError if the decoder is not
    installed.
    """
    if data[4:8] != b"ftyp":
        return None
    box = data[: min(int.from_bytes(data[:4], "big"), 256)]
    brands = {box[at : at + 4] for at in range(8, len(box), 4)}
    if brands & _AVIF_BRANDS:
        if not features.check("avif"):
            raise ImageError(name, "an AVIF picture, and this Pillow was built without AVIF: pip install -U pillow")
        return "AVIF"
    if not brands & _HEIC_BRANDS:
        return None  # a video
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        raise ImageError(name, "a HEIC picture, which needs pillow-heif: pip install 'touch-retrieval[heif]'") from None
    register_heif_opener()
    return "HEIF"


def _apply_draft_mode(image: Image.Image, min_side: int | None) -> None:
    """Select a smaller decoding size for a JPEG file that is too large or larger than `min_side` requires.

    Memory use then depends on the smaller size. A progressive file that is too large keeps its size, since its decoder
    stores the whole picture.
    """
    width, height = image.size
    if image.format != "JPEG" or width * height > MAX_DRAFT_PIXELS:
        return
    progressive = bool(image.info.get("progressive"))
    if progressive and width * height > MAX_PIXELS:
        return
    by_side = next(
        (each for each in _DRAFT_SCALES if min_side is not None and min(width, height) >= each * min_side), 1
    )
    by_pixels = next((each for each in (1, 2, 4, 8) if -(-width // each) * -(-height // each) <= MAX_PIXELS), None)
    if by_pixels and (scale := max(by_side, by_pixels)) > 1:
        image.draft(None, (width // scale, height // scale))


def pillow_rgb(image: Image.Image, name: str | Path) -> RgbImage:
    """Decode an opened Pillow image like `decode_rgb`; samples beyond 8 bits are lost, since Pillow drops them.

    Args:
        image: The opened image.
        name: Name of the picture in messages.

    Returns:
        (H, W, 3) float32 RGB in 0..1.

    Raises:
        ImageError: The image cannot be decoded.
    """
    try:
        check_pixels(image.size, name)
        with _suppressed_warnings:
            image.load()
            rgb = _eight_bit_rgb(image, name)
        return to_unit(_apply_orientation(rgb, _orientation(image)))
    except ImageError:
        raise
    except Exception as error:  # its file is damaged or closed
        raise ImageError(name, f"damaged or truncated: {_reason(error)}") from error


def check_pixels(size: tuple[int, int], name: str | Path) -> None:
    """Check a size from a header before anything of that size is allocated.

    Args:
        size: (width, height).
        name: Name of the picture in messages.

    Raises:
        ImageError: The size is empty, too large or too elongated.
    """
    width, height = size
    if width < 1 or height < 1:
        raise ImageError(name, f"has no pixels ({width} x {height})")
    if width * height > MAX_PIXELS:
        raise ImageError(name, _too_large(f"{width} x {height} = {width * height}"))
    if max(size) > min(MAX_SIDE, MAX_ASPECT * min(size)):
        raise ImageError(
            name,
            f"{width} x {height} pixels; a side may have at most {MAX_SIDE}, and {MAX_ASPECT} times the other side",
        )


def _too_large(size: str) -> str:
    return f"{size} pixels; at most {MAX_PIXELS} are decoded: make the picture smaller"


def _webp_size(data: bytes) -> tuple[int, int]:
    """Return (width, height) from a WebP header, else (1, 1).

    Pillow allocates a WebP canvas when it opens the file, so the size must be checked before that.
    """
    chunk = data[12:16]
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(data) < 30:
        return 1, 1
    if chunk == b"VP8X":
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    if chunk == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    width, height = struct.unpack_from("<HH", data, 26)
    return max(width & 0x3FFF, 1), max(height & 0x3FFF, 1)


def _tiff_tag(image: Image.Image, tag: int, default: tuple[int, ...]) -> tuple[int, ...]:
    value = getattr(image, "tag_v2", {}).get(tag, default)
    return tuple(value) if isinstance(value, tuple | list) else (int(value),)


def _eight_bit_rgb(image: Image.Image, name: str | Path) -> Samples:
    if image.mode not in _EIGHT_BIT_MODES:
        raise ImageError(name, f"pixel type {image.mode} is not supported; save it as 8 or 16-bit PNG")
    if not image.has_transparency_data:
        return _rgb(image)
    samples = to_float(np.asarray(image.convert("RGBA")))
    return _on_white(samples[..., :3], samples[..., 3:])


def _rgb(image: Image.Image) -> npt.NDArray[np.uint8]:
    """Return the samples of an opaque image of 8 bits, copied in strips because Pillow's conversion copies twice."""
    width, height = image.size
    rgb = np.empty((height, width, 3), np.uint8)
    rows = max(1, _STRIP // width)
    for top in range(0, height, rows):
        strip = image.crop((0, top, width, min(top + rows, height)))
        rgb[top : top + rows] = np.asarray(strip if strip.mode == "RGB" else strip.convert("RGB"))
    return rgb


def encode_image(pixels: npt.NDArray[np.uint8], ending: str = ".png") -> bytes:
    """Return the content of a picture file, of the format that `ending` names, from pixels (H, W, 3), red first."""
    import cv2

    return bytes(cv2.imencode(ending, np.ascontiguousarray(pixels[..., ::-1]))[1])


def _deep_grey(image: Image.Image, name: str | Path) -> RgbImage:
    """Decode 16-bit grey samples, which Pillow's conversion would clip."""
    if _tiff_tag(image, _BITS, (16,)) != (16,) or _tiff_tag(image, _PHOTOMETRIC, (1,)) != (1,):
        raise ImageError(name, "samples of 9 to 15 bits, or inverted ones, are not supported; save it as PNG")
    samples = np.asarray(image)[..., None]
    rgb = to_float(samples.astype(np.uint16).repeat(3, axis=2))
    if "transparency" in image.info:  # a PNG file may name one transparent level
        return _on_white(rgb, (samples != image.info["transparency"]).astype(np.float32))
    return rgb


def _on_white(rgb: RgbImage, alpha: npt.NDArray[np.float32]) -> RgbImage:
    """Composite on white: `rgb` (H, W, 3), `alpha` (H, W, 1), all in 0..1."""
    return rgb * alpha + (1 - alpha)


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation 1..8 to apply; 1 for TIFF files, since both decoders apply theirs."""
    if image.format == "TIFF":
        return 1
    try:
        value = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # the pixels are still usable
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def _apply_orientation(image: Samples, orientation: int) -> Samples:
    """Undo an EXIF orientation: 5..8 swap the axes, then rows (3, 4, 7, 8) and columns (2, 3, 6, 7) are reversed."""
    if orientation >= 5:
        image = image.swapaxes(0, 1)
    rows = -1 if orientation in (3, 4, 7, 8) else 1
    columns = -1 if orientation in (2, 3, 6, 7) else 1
    upright: Samples = np.ascontiguousarray(image[::rows, ::columns])  # type: ignore[assignment]
    return upright
