"""The gel check: is this a gel image, and is there contact?

A linear layer on the touch tower's features (`retrieval.model.fusion.GelHead`) classifies each finger's image: gel in
contact, gel without contact, or a picture that is not a gel image. With a no-contact frame, contact is the difference
from that frame, which needs no model.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from retrieval.data.resize import RgbImage, resize

CONTACT, NO_CONTACT, NOT_A_GEL = "contact", "no contact", "not a gel image"
BLOCKS = 16
"""Image blocks along each side for `contact_level`."""
Bounded = Annotated[float, Meta(ge=-1e6, le=1e6)]


@dataclass(frozen=True)
class GelCheck:
    """Thresholds of the gel check, chosen on validation objects; None if the recording had no examples.

    Attributes:
        foreign_above: An image is foreign (not a gel image), and its grasp is refused, if a finger's log-odds of "no
            gel image" exceed this.
        contact_above: A grasp has contact if the largest log-odds of contact over its fingers is at least this.
        level_above: A grasp has contact if the largest difference of a finger's gel image from its no-contact frame
            (`contact_level`, in grey levels of 255) is at least this. Used instead of `contact_above` if available.
        rates: Fractions of validation touches and foreign pictures that were refused, and of no-contact gels that were
            accepted.
    """

    foreign_above: Bounded | None
    contact_above: Bounded | None
    level_above: Bounded | None
    rates: Mapping[str, Bounded]

    def classify(self, readings: NDArray[np.float32], levels: NDArray[np.float32] | None = None) -> list[str]:
        """Classify each grasp as CONTACT, NO_CONTACT or NOT_A_GEL.

        Args:
            readings: (G, fingers, 2) log-odds of "no gel image" and of contact.
            levels: (G, fingers) differences of the images from their no-contact frames in grey levels, if available.
        """
        signs, above = readings[..., 1], self.contact_above
        if levels is not None and self.level_above is not None:
            signs, above = levels, self.level_above
        has_contact = True if above is None else signs.max(1) >= above
        is_gel = True if self.foreign_above is None else readings[..., 0].max(1) <= self.foreign_above
        classes = np.where(is_gel, np.where(has_contact, CONTACT, NO_CONTACT), NOT_A_GEL)
        return [str(name) for name in np.broadcast_to(classes, len(readings))]


def contact_level(touch: RgbImage, no_contact: RgbImage) -> float:
    """Return the largest difference of a gel image from its no-contact frame, in grey levels of 255.

    Both images are (H, W, 3) in 0..1, in any resolution. They are compared in 16 x 16 blocks, whose means suppress
    pixel noise.
    """
    size = (BLOCKS, BLOCKS)
    return 255 * float(np.abs(resize(touch, size) - resize(no_contact, size)).max())
