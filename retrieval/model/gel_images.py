"""A gel image as far as the matcher looks at it, which is far less than its file holds."""

from dataclasses import dataclass
from typing import NamedTuple

from retrieval.data.images import check_pixels, decode, picture_size
from retrieval.data.resize import RgbImage, Samples, check_rgb, resize_unchecked, to_unit
from retrieval.model.fusion_scorer import BLOCKS


@dataclass(frozen=True, eq=False)
class GelImage:
    """A gel image at the sizes that are looked at, float32 RGB in 0..1.

    file_bytes: of its file, 0 where it was none; answers tell it. touch (px, px, 3): for the tower of a model whose
    `touch_px` is px. blocks (16, 16, 3): to be compared with the no-contact frame; None where there is none.
    """

    file_bytes: int
    touch: RgbImage
    blocks: RgbImage | None

    @classmethod
    def of(cls, samples: Samples, px: int, compares_contact: bool, file_bytes: int = 0) -> "GelImage":
        """Resize a picture (H, W, 3). Raises BadInput."""
        check_rgb(to_unit(samples[:1, :1]), "touch")
        blocks = resize_unchecked(samples, (BLOCKS, BLOCKS)) if compares_contact else None
        return cls(file_bytes, resize_unchecked(samples, (px, px)), blocks)


class PictureSize(NamedTuple):
    """Pixels of a picture that was not decoded, as its file says."""

    width: int
    height: int

    @property
    def pixels(self) -> int:
        """Of the whole picture."""
        return self.width * self.height


def read_gel_image(data: bytes, name: str, px: int, compares_contact: bool, max_pixels: int) -> GelImage | PictureSize:
    """Decode a picture of at most `max_pixels` pixels and resize it; of a larger one only the size is returned.

    `name` stands for it in messages. Raises ImageError.
    """
    size = PictureSize(*picture_size(data, name))
    if size.pixels > max_pixels:
        return size
    check_pixels(size, name)
    return GelImage.of(decode(data, name), px, compares_contact, len(data))
