"""Decode picture files to float32 RGB in 0..1.

Pillow reads and checks every file. (OpenCV fills the missing part of a truncated JPEG with grey, without an error.) Of
16-bit colour Pillow keeps the high byte; 16-bit grey keeps all bits. Colour profiles and gamma chunks are not applied.
"""

import hashlib
import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageOps, UnidentifiedImageError

from _touch_retrieval.files import read_regular
from retrieval.data.resize import RgbImage, Samples, to_float
from retrieval.errors import ImageError

_AVIF_BRANDS = frozenset({b"avif", b"avis"})
_HEIC_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
EXTENSIONS = frozenset({".avif", ".bmp", ".heic", ".heif", ".hif", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
LOSSLESS = b"\x89PNG\r\n\x1a\n", b"BM", b"II*\0", b"MM\0*"
"""First bytes of PNG, BMP and TIFF files, which have no compression artefacts."""
MAX_PIXELS = 20_000_000
"""Maximum pixels of a decoded picture: 240 MB in float32. Larger JPEG files are decoded at 1/2, 1/4 or 1/8 size."""
MAX_DRAFT_PIXELS = 160_000_000
"""Maximum pixels of a JPEG file that is decoded at a smaller size."""
MAX_SIDE, MAX_ASPECT = 65_535, 200
"""Largest side in pixels (the limit of JPEG), and largest ratio of the longer to the shorter side."""
MAX_BYTES = 512 * 2**20

_EIGHT_BIT_MODES = frozenset({"1", "L", "P", "RGB", "RGBX", "CMYK", "YCbCr", "LA", "PA", "RGBA", "RGBa"})
_BITS, _PHOTOMETRIC = 258, 262

# Pillow warns of sizes and damaged metadata. Filters belong to the process: a thread must not change them for a while.
warnings.filterwarnings("ignore", module="PIL|pillow_heif")


def read_rgb(path: str | Path) -> RgbImage:
    """Read the picture at `path` as (H, W, 3) float32 RGB in 0..1, upright. Raises ImageError."""
    return decode_rgb(read_bytes(path), path)


def read_bytes(path: str | Path, digest: str | None = None) -> bytes:
    """Return the bytes of a regular file of at most MAX_BYTES.

    Raises:
        ImageError: The file cannot be read, or its SHA-256 is not `digest`, that of the picture in the index.
    """
    try:
        data = read_regular(path, MAX_BYTES)
    except FileNotFoundError:
        raise ImageError(path, "no such file") from None
    except (OSError, ValueError, MemoryError) as error:
        raise ImageError(path, f"cannot be read: {_reason(error)}") from error
    if digest is not None and hashlib.sha256(data).hexdigest() != digest:
        raise ImageError(path, "the file has changed since the index was built")
    return data


def decode_rgb(data: bytes, name: str | Path) -> RgbImage:
    """Decode like `decode`, to (H, W, 3) float32 RGB in 0..1. Raises ImageError."""
    return to_float(decode(data, name))


def decode(data: bytes, name: str | Path, min_side: int | None = None) -> Samples:
    """Decode one picture to RGB (H, W, 3): uint8 for an opaque picture of 8 bits, else float32 in 0..1.

    Grey becomes three equal channels, transparency is composited on white, and the EXIF orientation is applied. Of
    several pages or frames, the first is decoded.

    Args:
        data: Bytes of the file.
        name: Name of the picture in messages; so everywhere in this module.
        min_side: A JPEG file is decoded at 1/8, 1/4 or 1/2 of its size by its cosine transform, as long as the shorter
            side keeps this many pixels; each pixel is then nearly the mean of its area. None to decode only pictures
            smaller that are too large.

    Raises:
        ImageError: The bytes are not a picture that can be decoded.
    """
    with _image_errors(name), _open_image(data, name) as image:
        _apply_draft_mode(image, min_side)
        check_pixels(image.size, name)
        _load_upright(image)
        return _deep_grey(image, name) if image.mode.startswith("I;16") else _eight_bit_rgb(image, name)


def picture_size(data: bytes, name: str | Path) -> tuple[int, int]:
    """Return (width, height) from a picture's header, without decoding. Raises ImageError."""
    with _image_errors(name), _open_image(data, name) as image:
        width, height = image.size
        return width, height


def pillow_rgb(image: Image.Image, name: str | Path) -> RgbImage:
    """Decode an opened Pillow image like `decode_rgb`; samples beyond 8 bits are lost, since Pillow drops them.

    Raises:
        ImageError: The image cannot be decoded.
    """
    with _image_errors(name):
        check_pixels(image.size, name)
        _load_upright(image)
        return to_float(_eight_bit_rgb(image, name))


def _load_upright(image: Image.Image) -> None:
    """Decode the pixels, and apply the EXIF orientation."""
    image.load()
    with suppress(Exception):  # damaged EXIF data: the pixels are still usable
        ImageOps.exif_transpose(image, in_place=True)


@contextmanager
def _image_errors(name: str | Path) -> Iterator[None]:
    try:
        yield
    except ImageError:
        raise
    except UnidentifiedImageError:
        raise ImageError(
            name,
            "not a PNG, JPEG, BMP, TIFF, WebP, AVIF or HEIC picture, or its header is damaged or of an unsupported "
            "kind",
        ) from None
    except Image.DecompressionBombError:
        raise ImageError(name, _too_large("far more")) from None
    except Exception as error:  # OSError, SyntaxError, struct.error, MemoryError, a closed file, ...
        raise ImageError(name, f"damaged or truncated: {_reason(error)}") from error


def _open_image(data: bytes, name: str | Path) -> Image.Image:
    if not data:
        raise ImageError(name, "the file is empty")
    return Image.open(io.BytesIO(data), formats=_decoders(data, name))


def _reason(error: BaseException) -> str:
    text = getattr(error, "strerror", None) or str(error) or "no reason given"
    return f"{' '.join(text.split())} ({type(error).__name__})"


def is_picture(head: bytes) -> bool:
    """Return whether a file that begins with these bytes, 64 or more, is of a picture format that is read."""
    is_bitmap = head.startswith(b"BM") and head[6:10] == b"\0\0\0\0"
    is_webp = head.startswith(b"RIFF") and head[8:12] == b"WEBP"
    starts = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*")
    return head.startswith(starts) or is_bitmap or is_webp or bool(_brands(head) & (_AVIF_BRANDS | _HEIC_BRANDS))


def _brands(data: bytes) -> set[bytes]:
    """Return the brands in the box "ftyp" at the begin of a HEIC, AVIF or video file; else nothing."""
    box = data[: min(int.from_bytes(data[:4], "big"), 256)] if data[4:8] == b"ftyp" else b""
    return {box[at : at + 4] for at in range(8, len(box), 4)}


def _decoders(data: bytes, name: str | Path) -> tuple[str, ...]:
    """Return the names of Pillow's decoders for a file. Raises ImageError if the decoder is not installed."""
    brands = _brands(data)
    if brands & _AVIF_BRANDS or not brands & _HEIC_BRANDS:
        return ("AVIF", "BMP", "JPEG", "PNG", "TIFF", "WEBP")
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        raise ImageError(name, "a HEIC picture, which needs pillow-heif: pip install 'touch-retrieval[heif]'") from None
    register_heif_opener()
    return ("HEIF",)


def _apply_draft_mode(image: Image.Image, min_side: int | None) -> None:
    """Select a smaller decoding size for a JPEG file that is too large or larger than `min_side` requires.

    Memory use then depends on the smaller size. A progressive file that is too large keeps its size, since its decoder
    stores the whole picture.
    """
    width, height = image.size
    # An MPO file is a JPEG picture with further ones behind it.
    if image.format not in ("JPEG", "MPO") or width * height > MAX_DRAFT_PIXELS:
        return
    if image.info.get("progressive") and width * height > MAX_PIXELS:
        return
    by_side = [scale for scale in (1, 2, 4, 8) if min_side is not None and min(width, height) >= scale * min_side]
    by_pixels = [scale for scale in (1, 2, 4, 8) if -(-width // scale) * -(-height // scale) <= MAX_PIXELS]
    if by_pixels and (scale := max(by_side[-1:] + by_pixels[:1])) > 1:
        image.draft(None, (width // scale, height // scale))


def check_pixels(size: tuple[int, int], name: str | Path) -> None:
    """Raise ImageError if a size (width, height), from a header, is empty, too large or too elongated to allocate."""
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


def _eight_bit_rgb(image: Image.Image, name: str | Path) -> Samples:
    if image.mode not in _EIGHT_BIT_MODES:
        raise ImageError(name, f"pixel type {image.mode} is not supported; save it as 8 or 16-bit PNG")
    if not image.has_transparency_data:
        return np.array(image if image.mode == "RGB" else image.convert("RGB"))  # `convert` copies an RGB image, too
    samples = to_float(np.asarray(image.convert("RGBA")))
    return _on_white(samples[..., :3], samples[..., 3:])


def encode_image(pixels: npt.NDArray[np.uint8], ending: str = ".png") -> bytes:
    """Return the content of a picture file, of the format that `ending` names, from pixels (H, W, 3), red first."""
    import cv2

    return bytes(cv2.imencode(ending, np.ascontiguousarray(pixels[..., ::-1]))[1])


def _deep_grey(image: Image.Image, name: str | Path) -> RgbImage:
    """Decode 16-bit grey samples, which Pillow's conversion would clip."""
    tags = getattr(image, "tag_v2", {})
    if tags.get(_BITS, (16,)) != (16,) or tags.get(_PHOTOMETRIC, 1) != 1:
        raise ImageError(name, "samples of 9 to 15 bits, or inverted ones, are not supported; save it as PNG")
    samples = np.asarray(image)[..., None]
    rgb = to_float(samples.astype(np.uint16).repeat(3, axis=2))
    if "transparency" in image.info:  # a PNG file may name one transparent level
        return _on_white(rgb, (samples != image.info["transparency"]).astype(np.float32))
    return rgb


def _on_white(rgb: RgbImage, alpha: npt.NDArray[np.float32]) -> RgbImage:
    """Composite on white: `rgb` (H, W, 3), `alpha` (H, W, 1), all in 0..1."""
    return rgb * alpha + (1 - alpha)
