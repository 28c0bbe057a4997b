"""A gel image at the sizes that the matcher reads, which are far below the size of its file."""

from dataclasses import dataclass
from typing import NamedTuple

from retrieval.data.images import check_pixels, decode, picture_size
from retrieval.data.resize import RgbImage, Samples, check_rgb, resize_unchecked, to_unit
from retrieval.model.gel_check import BLOCKS


@dataclass(frozen=True, eq=False)
class GelImage:
    """A gel image at the sizes that the matcher reads, float32 RGB in 0..1.

    Attributes:
        file_bytes: Size of its file, for answers; 0 if it was none.
        touch: (px, px, 3) for the tower of a model whose `touch_px` is px.
        blocks: (16, 16, 3) for the comparison with the no-contact frame; None without one.
    """

    file_bytes: int
    touch: RgbImage
    blocks: RgbImage | None

    @classmethod
    def of(cls, samples: Samples, px: int, compares_contact: bool, file_bytes: int = 0) -> "GelImage":
        """Resize a picture.

        Args:
            samples: (H, W, 3) picture.
            px: Side of `touch`.
            compares_contact: Also make `blocks`.
            file_bytes: Size of its file.

        Raises:
            BadInput: The picture is not RGB.
        """
        check_rgb(to_unit(samples[:1, :1]), "touch")
        blocks = resize_unchecked(samples, (BLOCKS, BLOCKS)) if compares_contact else None
        return cls(file_bytes, resize_unchecked(samples, (px, px)), blocks)


class PictureSize(NamedTuple):
    """Size in pixels of a picture, read from its file without decoding it."""

    width: int
    height: int

    @property
    def pixels(self) -> int:
        """Number of pixels of the picture."""
        return self.width * self.height


def read_gel_image(data: bytes, name: str, px: int, compares_contact: bool, max_pixels: int) -> GelImage | PictureSize:
    """Decode and resize a picture, or return only its size if it is too large.

    Args:
        data: The picture's file.
        name: Its name in messages.
        px: Side of `GelImage.touch`.
        compares_contact: Also make `GelImage.blocks`.
        max_pixels: Largest number of pixels that are decoded.

    Raises:
        ImageError: The file is not a readable picture.
    """
    size = PictureSize(*picture_size(data, name))
    if size.pixels > max_pixels:
        return size
    check_pixels(size, name)
    return GelImage.of(decode(data, name), px, compares_contact, len(data))
