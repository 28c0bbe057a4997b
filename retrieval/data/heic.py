"""HEIC and AVIF pictures, which telephones take: which decoder of Pillow a file needs, and whether it is installed."""

from functools import cache
from pathlib import Path

from PIL import features

from retrieval.errors import ImageError

HEIC_EXTENSIONS = frozenset({".heic", ".heif", ".hif"})
AVIF_EXTENSIONS = frozenset({".avif"})
_AVIF_BRANDS = frozenset({b"avif", b"avis"})
_HEIC_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})


def decoder_of(data: bytes, name: str | Path) -> str | None:
    """Pillow's name of the decoder for these bytes, "HEIF" or "AVIF", made known to it; None for any other picture.

    Both files begin with a box of type "ftyp" that lists what its reader must know. Raises ImageError where the
    decoder is not installed.
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
        return None  # a film
    if not _heif_is_registered():
        raise ImageError(name, "a HEIC picture, which needs pillow-heif: pip install 'touch-retrieval[heif]'")
    return "HEIF"


@cache
def _heif_is_registered() -> bool:
    """Whether Pillow reads HEIC; tells it of the package that does."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True
