"""The gel check (`GelCheck`) and the match logits of the fusion head (`FusionScorer`), in numpy.

The gel check comes first: is this a gel image, and is there contact? A linear layer on the touch tower's features
(`retrieval.model.gel_head.GelHead`) classifies each finger's image: gel in contact, gel without contact, or a picture
that is not a gel image. With a no-contact frame, contact is the difference from that frame, which needs no model.

Pairs are scored from stored partial activations, with the photos in blocks. The head's layers after the partial
activations are one matrix product for all photos of a block. The rest is done in place, so the product takes most of
the time.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from _touch_retrieval.documents import typed
from retrieval.data.resize import RgbImage, resize
from retrieval.errors import BadInput, NumericalError
from retrieval.model.stored_partials import Partials, as_float32

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
        if levels is not None and self.level_above is not None:
            has_contact = levels.max(1) >= self.level_above
        elif self.contact_above is not None:
            has_contact = readings[..., 1].max(1) >= self.contact_above
        else:
            has_contact = np.ones(len(readings), dtype=bool)
        is_gel = np.ones(len(readings), dtype=bool)
        if self.foreign_above is not None:
            is_gel = readings[..., 0].max(1) <= self.foreign_above
        return [
            (CONTACT if contact else NO_CONTACT) if gel else NOT_A_GEL
            for gel, contact in zip(is_gel, has_contact, strict=True)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return a plain dictionary, as stored in checkpoints."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, data: Any) -> "GelCheck":
        """Inverse of `to_dict`. Raises BadInput for anything else."""
        return typed(data, cls, "gel_check", complete=True, error=BadInput)


def contact_level(touch: RgbImage, no_contact: RgbImage) -> float:
    """Return the largest difference of a gel image from its no-contact frame, in grey levels of 255.

    Both images are (H, W, 3) in 0..1. They are compared in 16 x 16 blocks, whose means suppress pixel noise.
    """
    size = (BLOCKS, BLOCKS)
    return 255 * float(np.abs(resize(touch, size) - resize(no_contact, size)).max())


Floats = NDArray[np.float32]
BLOCK = 2048
"""Number of photos that are scored together."""
CELL_BLOCK = 64
"""The same for scores of cells, whose vectors then fit into the processor's cache."""


@dataclass(frozen=True)
class FusionScorer:
    """The layers of a fusion head after its partial activations.

    A partial activation is a concatenation [hidden (H), scaled contrastive embedding (E), vectors of cells]. The match
    logit is `out . relu(second relu(touch_hidden + photo_hidden) + second_bias) + out_bias + touch_embedding .
    photo_embedding + sum over cells i of the touch of max over cells j of the photo of touch_cell_i . photo_cell_j`.
    The second term is a scaled cosine similarity, and E is 0 for a head without it (`cosine`). The last term is left
    out if the photos have no cells.

    Attributes:
        second: (H, H) weights of the second layer. All arrays are float32.
        second_bias: (H,) its bias.
        out: (H,) weights of the output.
        out_bias: (1,) its bias.
        cosine_dim: E.
        cell_dim: Length of a cell's vector; 0 without cells.
    """

    second: Floats
    second_bias: Floats
    out: Floats
    out_bias: Floats
    cosine_dim: int = 0
    cell_dim: int = 0

    @property
    def pooled_width(self) -> int:
        """Width of a partial activation without cells."""
        return len(self.out) + self.cosine_dim

    @property
    def cosine_columns(self) -> slice:
        """The columns of a partial activation that are the scaled embedding."""
        return slice(len(self.out), self.pooled_width)

    def logits(self, touch_partials: Floats, photo_partials: Partials, rows: NDArray[np.int64] | None = None) -> Floats:
        """Return the match logits of photos, summed over grasps: (len(rows),).

        A plain sum: the posterior corrects it for the dependence of grasps. Photos are read in blocks and converted to
        float32.

        Args:
            touch_partials: (G, touch partial) partial activations of G grasps of ONE object.
            photo_partials: (N, partial) of the photos, in any float type or as stored.
            rows: Photos to score; None for all.

        Raises:
            NumericalError: A logit is NaN or infinite: sorting would rank it first.
        """
        count = len(photo_partials) if rows is None else len(rows)
        has_cells = self.cell_dim > 0 and photo_partials.shape[1] > self.pooled_width
        block = CELL_BLOCK if has_cells else BLOCK
        scores = np.empty(count, dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # the check below names the row
            for start in range(0, count, block):
                part = slice(start, min(start + block, count))
                photos = as_float32(photo_partials[part] if rows is None else photo_partials[rows[part]])
                scores[part] = self._sum_of_logits(touch_partials, photos)
                if has_cells:
                    scores[part] += self._sum_of_cell_scores(touch_partials, photos)
        if not np.isfinite(scores).all():
            bad = int(np.flatnonzero(~np.isfinite(scores))[0])
            name = bad if rows is None else int(rows[bad])
            raise NumericalError(f"every match logit must be finite; photo row {name} has {scores[bad]}")
        return scores

    def _sum_of_logits(self, touch_partials: Floats, photos: Floats) -> Floats:
        width = len(self.out)
        hidden, second = (np.empty((len(photos), width), dtype=np.float32) for _ in range(2))
        total: Floats = photos[:, self.cosine_columns] @ touch_partials[:, self.cosine_columns].sum(0)
        total += len(touch_partials) * self.out_bias[0]
        for touch_partial in touch_partials:
            np.add(photos[:, :width], touch_partial[:width], out=hidden)
            np.maximum(hidden, 0, out=hidden)
            np.matmul(hidden, self.second.T, out=second)
            second += self.second_bias
            np.maximum(second, 0, out=second)
            total += second @ self.out
        return total

    def _sum_of_cell_scores(self, touch_partials: Floats, photos: Floats) -> Floats:
        """Return, for each photo, the sum over all touch cells of the largest inner product with one of its cells."""
        touch_cells = np.ascontiguousarray(touch_partials[:, self.pooled_width :]).reshape(-1, self.cell_dim)
        photo_cells = photos[:, self.pooled_width :].reshape(-1, self.cell_dim)
        products = photo_cells @ touch_cells.T
        best: Floats = products.reshape(len(photos), -1, len(touch_cells)).max(1)
        return np.asarray(best.sum(1))
